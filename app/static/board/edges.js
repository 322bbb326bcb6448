/** The relations to draw, as edges between the boxes of their objects. */

/**
 * @typedef {object} Edge
 * @property {string} key
 * @property {string} subject id
 * @property {string} object id
 * @property {string} words
 * @property {'expected' | 'holds' | 'disagrees' | 'misplaced' | 'drawn'} kind
 */

import { percent, SPOKEN } from './words.js';

/** The alarms of an answer: outliers and misplaced relations. */
export const wrongIn = (answer) => ({
  outliers: answer.outliers.filter((one) => one.is_outlier),
  misplaced: answer.misplaced.filter((one) => one.is_misplaced),
});

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
  const answer = state.answers[state.shown][state.tab]?.answer;
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
