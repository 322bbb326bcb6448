/** The three questions that are asked about every board, as bodies of requests. */

import { toScene } from './scene.js';

export const QUESTIONS = ['missing', 'outliers', 'relations'];

/** What of the state a question depends on: when none of it changed, no answer does. */
export const DEPENDS = [
  'things', 'viewer', 'room', 'models', 'at', 'coverage', 'sensitivity', 'threshold', 'suggestions', 'least', 'most', 'unknown',
  'words', 'epoch',
];

/** Sizes that a model takes for typical, by label. */
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

/** @returns {object | null} null: nothing to ask */
export function bodyOf(state, question, model) {
  if (!state.things.length || !model) return null;
  return {
    ...toScene(state, sizesOf(state, state.models[0])),
    model,
    ...(state.unknown !== 'error' && { unknown_labels: state.unknown }),
    ...OWN[question](state),
  };
}
