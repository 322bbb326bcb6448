/** The relations to draw, as edges between the boxes of their objects. */

/**
 * @typedef {object} Edge
 * @property {string} key
 * @property {string} subject id
 * @property {string} object id
 * @property {string} words
 * @property {'expected' | 'holds' | 'disagrees' | 'misplaced' | 'drawn'} kind
 */

import { aboutOf, classesOf, habitOf } from './habits.js';
import { percent, SPOKEN } from './words.js';

/** A relation as one text, for comparisons. */
export const keyOf = ({ subject, relation, object }) => JSON.stringify([subject, relation, object]);

/**
 * The answer about outliers of a model, without the alarms that the user confirmed as right; undefined without an answer.
 * `covered_by` names the confirmed scene or object that covers the habit behind an alarm.
 */
export function judgedBy(own, { things, right, line, room, covered }) {
  const answer = own.outliers?.answer;
  // In a confirmed scene, all objects belong there and stand right, also those that are added later.
  const belongs = new Set(things.filter((thing) => line.confirmed || thing.belongs).map(({ id }) => id));
  if (!answer || !(belongs.size || right.length || covered.size)) return answer ?? undefined;
  const stands = (one) => line.confirmed || right.includes(keyOf(one));
  const classes = classesOf(answer);
  const habit = (one) => habitOf(aboutOf(one, classes), room);
  const covers = new Map(covered);
  for (const one of answer.outliers) if (one.is_outlier && belongs.has(one.object)) covers.set(habit(one), one.object);
  for (const one of answer.misplaced) if (one.is_misplaced && stands(one)) covers.set(habit(one), one.subject);
  const judged = (one, alarm, isRight) => {
    if (isRight) return { ...one, [alarm]: false, confirmed: true };
    const by = one[alarm] && covers.get(habit(one));
    return by ? { ...one, [alarm]: false, confirmed: true, covered_by: by } : one;
  };
  return {
    ...answer,
    outliers: answer.outliers.map((one) => judged(one, 'is_outlier', belongs.has(one.object))),
    misplaced: answer.misplaced.map((one) => judged(one, 'is_misplaced', one.is_misplaced && stands(one))),
  };
}

/** Whether an object is probably a wrong detection, and no person has confirmed it. */
export const isDoubtful = (one) => one?.reason === 'misdetection' && !one.confirmed;

/** The alarms of an answer: outliers and misplaced relations. */
export const wrongIn = (answer) => ({
  outliers: answer.outliers.filter((one) => one.is_outlier),
  misplaced: answer.misplaced.filter((one) => one.is_misplaced),
});

/** The number of alarms without a verdict; undefined until the model has answered about the board. */
export function openAlarms(state) {
  const own = state.answers[state.shown];
  if (own.outliers?.status !== 'answered') return undefined;
  const { outliers, misplaced } = wrongIn(judgedBy(own, state));
  const ids = new Set(state.things.map(({ id }) => id));
  return [...outliers.map((one) => [one.object]), ...misplaced.map((one) => [one.subject, one.object])]
    .filter((ends) => ends.every((id) => ids.has(id) || id === 'floor')).length; // without objects that were just removed
}

const ofTab = {
  relations: ({ disagreements, relations }) => [
    ...disagreements.map((one) => edge(
      { ...one, relation: one.expected },
      'disagrees',
      `${SPOKEN[one.expected]}? ${percent(one.probability)}`,
    )),
    ...relations.map((one) =>
      edge(one, one.observed ? 'holds' : 'expected', `${SPOKEN[one.relation]} ${percent(one.probability)}`)),
  ],
  outliers: (answer) => wrongIn(answer).misplaced.map((one) => edge(one, 'misplaced', `${SPOKEN[one.relation]}?`)),
};

/** @returns {Edge[]} */
export function edgesOf(state) {
  if (state.draft) {
    return onePerPair(state.draft.relations.map((one) => edge(one, 'drawn', SPOKEN[one.relation])))
      .filter((one) => state.selected && [one.subject, one.object].includes(state.selected));
  }
  const own = state.answers[state.shown];
  const answer = state.tab === 'outliers' ? judgedBy(own, state) : own[state.tab]?.answer;
  return answer && ofTab[state.tab] ? onePerPair(ofTab[state.tab](answer)) : [];
}

const edge = ({ subject, object, relation }, kind, words) => ({
  key: JSON.stringify([kind, subject, relation, object]), subject, object, words, kind,
});

/** Keeps the best edge of each pair, because further edges would hide its text. */
function onePerPair(edges) {
  const taken = new Set();
  return edges.filter(({ subject, object }) => {
    const pair = JSON.stringify([subject, object].sort());
    return !taken.has(pair) && taken.add(pair);
  });
}
