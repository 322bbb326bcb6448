/** The relations to draw, as edges between the boxes of their objects. */

/**
 * @typedef {object} Edge
 * @property {string} key
 * @property {string} subject id
 * @property {string} object id
 * @property {string} words
 * @property {'expected' | 'holds' | 'observed' | 'disagrees' | 'against' | 'misplaced' | 'drawn'} kind
 */

import { percent, SPOKEN } from './words.js';

/** The alarms of an answer: outliers and misplaced relations. */
export const wrongIn = (answer) => ({
  outliers: answer.outliers.filter((one) => one.is_outlier),
  misplaced: answer.misplaced.filter((one) => one.is_misplaced),
});

/** The relations in the list: all, or only those of the selected object. */
export const listed = (state, relations) =>
  state.own && state.selected
    ? relations.filter(({ subject, object }) => [subject, object].includes(state.selected))
    : relations;

const ofTab = {
  relations(state) {
    const answer = state.answers[state.shown].relations?.answer;
    if (!answer) return [];
    const edges = disagreements(state, answer);
    for (const one of listed(state, answer.relations)) {
      const kind = one.observed ? 'holds' : 'expected';
      edges.push(edge(one, kind, `${SPOKEN[one.relation]} ${percent(one.probability)}`));
    }
    if (state.observed) {
      for (const one of listed(state, answer.observed_relations ?? [])) {
        edges.push(edge(one, 'observed', SPOKEN[one.relation]));
      }
    }
    return onePerPair(edges);
  },

  outliers(state) {
    const answer = state.answers[state.shown].outliers?.answer;
    if (!answer) return [];
    const against = answer.outliers
      .filter((one) => one.is_outlier || one.object === state.selected)
      .flatMap((one) => one.because.map((reason) => ({ subject: one.object, ...reason })))
      .filter((reason) => reason.log_odds_change < 0)
      .map((reason) => edge(reason, 'against', reason.log_odds_change.toFixed(1).replace('-', '−')));
    const misplaced = wrongIn(answer).misplaced
      .map((one) => edge(one, 'misplaced', `${SPOKEN[one.relation]}? ${percent(one.probability)}`));
    return onePerPair([...misplaced, ...against]);
  },

  missing: () => [],
  generate: () => [],
};

/** @returns {Edge[]} */
export function edgesOf(state) {
  if (state.draft) {
    return onePerPair(state.draft.relations.map((one) => edge(one, 'drawn', SPOKEN[one.relation])))
      .filter((one) => state.selected && [one.subject, one.object].includes(state.selected));
  }
  return ofTab[state.tab](state);
}

function disagreements(state, answer) {
  return listed(state, answer.disagreements).map((one) =>
    edge(
      { ...one, relation: one.expected },
      'disagrees',
      `${SPOKEN[one.expected]} ${percent(one.probability)}, but ${one.observed.map((name) => SPOKEN[name]).join(', ')}`,
    ),
  );
}

const edge = ({ subject, object, relation = '' }, kind, words) => ({
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
