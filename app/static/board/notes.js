/** The notes of the service on a file that it has read: which values the scene leaves out, and why. */

import { el } from './dom.js';
import { shown } from './words.js';

const MOST_FLAT = 3; // notes without folds
const MOST_LISTED = 20; // notes of a kind
const MOST_LETTERS = 300; // of a note

/** The kinds of notes, by the codes of the service. */
const KINDS = {
  'no-hypothesis': 'Detections without a class',
  'low-score': 'Detections with a low score',
  'high-score': 'Scores above 1',
  percent: 'Scores in percent',
  'no-label': 'Class ids without a label',
  unwanted: 'Classes that the label map leaves out',
  'too-many': 'More than a request can have',
  'no-position': 'Objects without a usable position',
  'no-box': 'Boxes that cannot be used',
  degrees: 'Rotations in degrees',
  renamed: 'Renamed objects',
  'no-stamp': 'Times that cannot be read',
  excluded: 'Entries that the file excludes',
  unread: 'Fields that are not read',
};

const wordsOf = ({ detection, detail }) => shown(detection === null ? detail : `detection ${detection}: ${detail}`, MOST_LETTERS);

/** The number of notes in words; '' without notes. */
export const countOf = ({ length }) => (length ? `The file was read with ${length === 1 ? '1 note' : `${length} notes`}.` : '');

function listed(notes) {
  const rest = notes.length - MOST_LISTED;
  return el('ul', {}, ...notes.slice(0, MOST_LISTED).map((note) => el('li', {}, wordsOf(note))),
    ...(rest > 0 ? [el('li', { class: 'quiet' }, `and ${rest} more`)] : []));
}

function byKind(notes) {
  const kinds = Map.groupBy(notes, ({ reason }) => reason);
  return [...kinds].sort(([, a], [, b]) => b.length - a.length).map(([reason, found]) => el('details', {},
    el('summary', {}, `${KINDS[reason] ?? shown(reason)} (${found.length})`), listed(found)));
}

/**
 * @param {HTMLElement} node
 * @param {HTMLElement} next gets the focus after “Dismiss”
 * @returns {(notes: object[]) => void} shows the notes of a file; without notes, it hides the part
 */
export function createNotes(node, next) {
  return function show(notes) {
    node.hidden = !notes.length;
    if (!notes.length) return;
    const dismiss = el('button', {
      type: 'button', 'aria-label': 'Dismiss the notes',
      onclick: () => {
        node.hidden = true;
        next.focus();
      },
    }, 'Dismiss');
    node.replaceChildren(el('header', {}, el('h3', {}, countOf(notes)), dismiss),
      ...(notes.length > MOST_FLAT ? byKind(notes) : [listed(notes)]));
  };
}
