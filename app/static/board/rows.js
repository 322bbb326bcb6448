/** The rows of answers: a name, a probability with a bar, reasons and buttons. */

import { bar, el } from './dom.js';
import { percent, SPOKEN } from './words.js';

export const spoken = ({ subject, relation, object }, name) => `${name(subject)} ${SPOKEN[relation]} ${name(object)}`;

/** Reasons in words: "bed, lamp speak for it; oven speaks against it". What raises the log-odds of an outlier speaks against it. */
export function reasons(because, name, { company = [], raised = 1 } = {}) {
  const speak = (side, objects) =>
    objects.length ? `${objects.join(', ')} ${objects.length > 1 ? 'speak' : 'speaks'} ${side} it` : '';
  const named = (sign) => because.filter((one) => sign * raised * one.log_odds_change > 0).map(({ object }) => name(object));
  const words = [
    company.length ? `usually seen with ${company.join(', ')}` : '',
    speak('for', named(1)), speak('against', named(-1)),
  ].filter(Boolean).join('; ');
  return words ? el('p', { class: 'quiet reasons' }, words) : null;
}

const MOST_NAMES = 8; // of a sentence

/** Names in a sentence: "bed, lamp and 4 more". */
export const some = (names) => (names.length > MOST_NAMES + 1
  ? `${names.slice(0, MOST_NAMES).join(', ')} and ${names.length - MOST_NAMES} more` : names.join(', '));

/** Collapsible parts of answers. They stay as the user left them until `clear`. */
export function createFolds() {
  const opened = new Set();
  return {
    fold(key, words, ...children) {
      const node = el('details', {
        open: opened.has(key), ontoggle: () => (node.open ? opened.add(key) : opened.delete(key)),
      }, el('summary', { 'data-key': key }, words), ...children);
      return node;
    },
    clear: () => opened.clear(),
  };
}

/** @param {{kind?: string, words?: string, unit?: string, was?: number | null, buttons?: HTMLElement[]}} flag `was`: the former probability */
export const row = (kind, words, probability, { kind: own = '', words: flag, unit = '', was = null, buttons = [] }, ...more) =>
  el('li', { class: own },
    el('div', { class: 'headline' }, words, flag ? el('span', { class: 'flag' }, flag) : null,
      was === null ? null : el('span', { class: 'quiet' }, `${percent(was)} →`),
      el('span', {}, `${percent(probability)}${unit}`), ...buttons),
    bar(probability, kind, was), ...more);

/** A button that confirms an answer. The name of its object follows the visible words. */
export const verdict = (words, about, onclick) => el('button', {
  type: 'button', class: 'verdict', 'data-key': `${words} ${about}`, 'aria-label': `${words}: ${about}`,
  // The second click of a double click would hit the next row.
  onclick: ({ detail }) => detail < 2 && onclick(),
}, words);

/** The class of an entry, if the request has another word for it. */
export const classOf = ({ label, listed_as: word }) => (word ? el('p', { class: 'quiet' }, `class: ${label}`) : null);

/** Whether a person has confirmed an entry, or the same habit elsewhere. */
export const confirmedWords = ({ confirmed, covered_by: by }, name) => (by ? `✓ covered by ${name(by)}` : confirmed ? 'confirmed' : '');

