/** The bodies of the three questions that the page asks about every scene. */

import { toScene } from './scene.js';

export const QUESTIONS = ['missing', 'outliers', 'relations'];

/** The parts of the state that the answers depend on. */
export const DEPENDS = [
  'things', 'viewer', 'room', 'models', 'at', 'coverage', 'sensitivity', 'threshold', 'suggestions', 'least', 'most', 'unknown',
  'words', 'epoch',
];

/** Typical sizes of a model's classes, by label. */
export const sizesOf = (state, model) => state.words[model]?.sizes ?? new Map();

const OWN = {
  missing: (state) => ({
    top_k: state.suggestions,
    ...(state.coverage !== null && { coverage: state.coverage }),
    ...(state.at && { at: state.at }),
  }),
  outliers: (state) => ({
    ...(state.sensitivity !== 'medium' && { sensitivity: state.sensitivity }),
    ...(state.threshold !== null && { threshold: state.threshold }),
  }),
  relations: (state) => ({ top_k: state.most, min_probability: state.least }),
};

/** @returns {object | null} null for an empty scene or without a model */
export function bodyOf(state, question, model) {
  if (!state.things.length || !model) return null;
  return {
    ...toScene(state, sizesOf(state, state.models[0])),
    model,
    ...(state.unknown !== 'error' && { unknown_labels: state.unknown }),
    ...OWN[question](state),
  };
}
