/** The bodies of the questions that the page asks about every scene. */

import { toScene } from './scene.js';
import { shown } from './words.js';

/** The questions with a tab of their own. */
export const QUESTIONS = ['missing', 'outliers', 'relations'];
/** All questions; the list of room types shows the answer to `rooms`. */
export const ASKED = [...QUESTIONS, 'rooms'];

/** The parts of the state that the answers depend on. */
export const DEPENDS = [
  'things', 'relations', 'posed', 'viewer', 'room', 'models', 'at', 'sensitivity', 'words', 'epoch',
];

const SUGGESTIONS = 5;
const MOST_RELATIONS = 12;
const ALL_ROOMS = 4096; // maximum of the service
/** Minimum probability of a relation or place that the page shows. */
export const LIKELY = 0.25;

/** Typical sizes of a model's classes, by label. */
export const sizesOf = (state, model) => state.words[model]?.sizes ?? new Map();

/** Labels of a model's classes that hang on a wall or from the ceiling. */
export const hangingOf = (state, model) => state.words[model]?.hanging ?? new Set();

/** How a model reads a label of no class: as a similar class, then by its meaning, else it leaves the object out. */
export const UNKNOWN_LABELS = 'by-meaning';

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

/** The scene as a model gets it. */
export const sceneFor = (state) => toScene(state, sizesOf(state, state.models[0]));

/** @returns {object | null} null if there is nothing to ask; `whyNot` gives the reason */
export function bodyOf(state, question, model) {
  if (whyNot(state, question, model)) return null;
  const scene = sceneFor({ ...state, ...NO_EVIDENCE[question] });
  return { ...scene, model, unknown_labels: UNKNOWN_LABELS, ...OWN[question](state) };
}

/** The reason why the page does not ask this question, or ''. */
export function whyNot(state, question, model) {
  if (!model) return 'Choose a model first.';
  if (!state.things.length) return 'Put an object on the board first.';
  return question === 'missing' && common(state)?.length === 0 ? 'The two models have no class in common.' : '';
}

/** The entries of a field in all answers of a model. */
const inAnswers = (state, column, field) =>
  QUESTIONS.flatMap((question) => state.answers[column][question]?.answer?.[field] ?? []);

/** The ids of the objects that a model left out, because it knows neither their labels nor their meanings. */
export function leftOut(state, column) {
  const errors = QUESTIONS.flatMap((question) => state.answers[column][question]?.problem?.errors ?? []);
  // The service refuses a request without any known object.
  const all = errors.some(({ pointer }) => pointer === '#/objects');
  return new Set(all ? state.things.map(({ id }) => id) : inAnswers(state, column, 'ignored'));
}

/** How a model reads a name that is no label of its own: {class, similarity}, or undefined. */
export const mappedBy = (state, column, name) =>
  inAnswers(state, column, 'mapped').find(({ label }) => label === name);

/** Whether the shown model reads a name for certain as one of its classes, such as "hall" as "corridor". */
export const isCertain = (state, name) => Boolean(state.answers) && mappedBy(state, state.shown, name)?.similarity === 1;

/**
 * How a model reads an unknown name: ["fridgee →", "fridge"], ["hall → corridor"] for certain, ["flux not known, left out"],
 * ["tractor read by its meaning, like forklift"], or [].
 * @param {'objects' | 'rooms'} kind
 * @returns {string[]} words, then the similar class of a guess
 */
export function reading(state, column, kind, name) {
  const left = leftOut(state, column);
  const names = kind === 'rooms' ? [name] : state.things.filter(({ label }) => label === name).map(({ id }) => id);
  if (names.some((one) => left.has(one))) return [`${shown(name)} not known, left out`];
  const found = mappedBy(state, column, name);
  if (!found) return [];
  if (found.rule === 'meaning') return [`${shown(name)} read by its meaning, like ${found.class}`];
  return found.similarity < 1 ? [`${shown(name)} →`, found.class] : [`${shown(name)} → ${found.class}`];
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
