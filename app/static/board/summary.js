/** A summary of the answers for the live region, which screen readers read aloud. */

import { judgedBy, wrongIn } from './edges.js';
import { likely } from './ghosts.js';
import { QUESTIONS } from './questions.js';
import { namesOf, percent, SPOKEN } from './words.js';

const MOST_SAID = 3; // maximum number of listed relations

/** @returns {string | null} null until all questions are answered */
export function summary(state) {
  const own = state.answers[state.shown];
  if (!QUESTIONS.every((question) => own[question]?.status === 'answered')) return null;
  const name = namesOf(state.things);
  const parts = [];
  const [first] = likely(own, state);
  if (first) {
    const [place] = first.placements;
    const where = place ? ` ${SPOKEN[place.relation]} ${name(place.object)}` : '';
    parts.push(`Most likely missing: ${first.label}${where}, ${percent(first.probability)}.`);
  }
  const { outliers, misplaced } = wrongIn(judgedBy(own, state));
  if (outliers.length) parts.push(`Does not belong here: ${outliers.map((one) => name(one.object)).join(', ')}.`);
  if (misplaced.length) {
    const places = misplaced.map(({ subject, relation, object, moved }) =>
      `${name(subject)} ${SPOKEN[relation]} ${name(object)}${moved == null ? '' : ` (moved: ${name(moved)})`}`);
    const rest = places.length > MOST_SAID ? ` and ${places.length - MOST_SAID} more` : '';
    parts.push(`In the wrong place: ${places.slice(0, MOST_SAID).join(', ')}${rest}.`);
  }
  if (!outliers.length && !misplaced.length) parts.push('Nothing looks wrong.');
  return parts.join(' ');
}
