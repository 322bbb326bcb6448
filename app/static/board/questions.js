/** The bodies of the questions that the page asks about every scene. */

import { toScene } from './scene.js';
import { namesOf } from './words.js';

/** The questions with a tab of their own. */
export const QUESTIONS = ['missing', 'outliers', 'relations'];
/** All questions; the list of room types shows the answer to `rooms`. */
export const ASKED = [...QUESTIONS, 'rooms'];

/** The parts of the state that the answers depend on. */
export const DEPENDS = [
  'things', 'relations', 'posed', 'viewer', 'room', 'models', 'at', 'sensitivity', 'refused', 'words', 'epoch',
];

const SUGGESTIONS = 5;
const MOST_RELATIONS = 12;
const ALL_ROOMS = 4096; // maximum of the service
/** Minimum probability of a relation or place that the page shows. */
export const LIKELY = 0.25;

/** Typical sizes of a model's classes, by label. */
export const sizesOf = (state, model) => state.words[model]?.sizes ?? new Map();

/** The labels that a model refused. @returns {Map<string, string[]>} label → similar names */
export const refusedBy = (state, model) => state.refused[model] ?? new Map();

/** The objects of the board that a model knows, or may know. */
export const knownTo = (state, model) =>
  state.things.filter((thing) => !refusedBy(state, model).has(thing.label));

/** The classes that both models can propose; null with one model or with equal vocabularies. */
export function common(state) {
  const [first, second] = state.models.map((model) => state.words[model]);
  if (!first || !second) return null;
  const others = new Set(second.proposed);
  const shared = first.proposed.filter((label) => others.has(label));
  return shared.length === first.proposed.length && shared.length === others.size ? null : shared;
}

const OWN = {
  missing(state) {
    const candidates = common(state);
    return { top_k: SUGGESTIONS, ...(state.at && { at: state.at }), ...(candidates && { candidates }) };
  },
  outliers: ({ sensitivity }) => (sensitivity === 'medium' ? {} : { sensitivity }),
  relations: () => ({ top_k: MOST_RELATIONS, min_probability: LIKELY }),
  rooms: () => ({ top_k: ALL_ROOMS, detail: 'scores' }),
};

/** The parts of a scene that are no evidence about its room type. A change of them asks nothing again. */
const NO_EVIDENCE = { rooms: { room: '', relations: [], posed: false } };

/** The scene as a model gets it, without the labels that it refused. */
export const sceneFor = (state, model) =>
  toScene({ ...state, things: knownTo(state, model) }, sizesOf(state, state.models[0]));

/** @returns {object | null} null if there is nothing to ask; `whyNot` gives the reason */
export function bodyOf(state, question, model) {
  if (whyNot(state, question, model)) return null;
  const scene = sceneFor({ ...state, ...NO_EVIDENCE[question] }, model);
  return { ...scene, model, unknown_labels: 'nearest', ...OWN[question](state) };
}

/** The reason why the page does not ask this question, or ''. */
export function whyNot(state, question, model) {
  if (!model) return 'Choose a model first.';
  if (!state.things.length) return 'Put an object on the board first.';
  const known = knownTo(state, model);
  if (!known.length) return 'The model knows none of the objects.';
  if (question !== 'missing') return '';
  if (state.at && !known.some(({ id }) => id === state.at.object)) return `The model does not know ${namesOf(state.things)(state.at.object)}.`;
  return common(state)?.length === 0 ? 'The two models have no class in common.' : '';
}

/** The entries of a field in all answers of a model. */
const inAnswers = (state, column, field) =>
  QUESTIONS.flatMap((question) => state.answers[column][question]?.answer?.[field] ?? []);

/** How a model reads a name that is no label of its own: {class, similarity}, or undefined. */
export const mappedBy = (state, column, name) =>
  inAnswers(state, column, 'mapped').find(({ label }) => label === name);

/** Whether the shown model reads a name for certain as one of its classes, such as "hall" as "corridor". */
export const isCertain = (state, name) => Boolean(state.answers) && mappedBy(state, state.shown, name)?.similarity === 1;

/**
 * How a model reads an unknown name: ["fridgee →", "fridge"], ["hall → corridor"] for certain, ["flux not known, left out"], or [].
 * @param {'objects' | 'rooms'} kind
 * @returns {string[]} words, then similar names
 */
export function reading(state, column, kind, name) {
  // The service ignores an unknown room type, and refuses unknown labels with similar names.
  const similar = kind === 'rooms'
    ? inAnswers(state, column, 'ignored').includes(name) && []
    : refusedBy(state, state.models[column]).get(name);
  if (similar) return [`${name} not known, left out${similar.length ? ':' : ''}`, ...similar];
  const found = mappedBy(state, column, name);
  if (!found) return [];
  return found.similarity < 1 ? [`${name} →`, found.class] : [`${name} → ${found.class}`];
}

/** A reading as text: "fridgee → fridge?". */
export const inWords = ([words, ...names]) => [words, ...names.map((name) => `${name}?`)].join(' ');

/** The readings of all models. Different readings of two models begin with the name of the model. */
export function readings(state, kind, name) {
  const found = state.models.flatMap((model, column) => (model ? [[model, ...reading(state, column, kind, name)]] : []));
  const different = new Set(found.map(([, ...words]) => String(words))).size > 1;
  const told = found.filter(([, words]) => words);
  if (!different) return told.slice(0, 1).map(([, ...words]) => words);
  return told.map(([model, words, ...names]) => [`${model}: ${words}`, ...names]);
}
