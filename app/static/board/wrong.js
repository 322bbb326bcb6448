/** The answers about wrong objects and places: alarms first, in groups, so that a person finds them in a large scene. */

import { el } from './dom.js';
import { isDoubtful, judgedBy } from './edges.js';
import { aboutOf, classesOf } from './habits.js';
import { newLine } from './records.js';
import { classOf, confirmedWords, reasons, row, some, spoken, verdict } from './rows.js';
import { percent, resolvedWords, shown, SPOKEN, wordOf } from './words.js';

const MOST_FLAT = 6; // entries of a group without folds
const MOST_ALARMS = 5; // visible entries of a longer group of alarms
const NEAREST = 3; // visible objects without alarm if nothing is wrong

/** The groups in their order. The kinds of misplaced entries are the reasons of the service. */
const GROUPS = {
  'does-not-belong': 'Does not belong here',
  'on-floor': 'Stands on the floor, but belongs elsewhere',
  'wrong-support': 'On or in the wrong object',
  floats: 'On no listed object',
  'sunk-in': 'Sunk into the floor or an object',
  relation: 'Stated relation is probably wrong',
  misdetection: 'Probably a wrong detection',
  confirmed: 'Confirmed',
  fits: 'No alarm',
};
const ALARMS = ['does-not-belong', 'on-floor', 'wrong-support', 'floats', 'sunk-in', 'relation'];

/**
 * @typedef {object} Entry
 * @property {string} group
 * @property {number} probability
 * @property {string} habit the habit behind an alarm; alarms with the same habit are one fold
 * @property {string} words of the habit
 * @property {HTMLLIElement} node
 */

/** @returns {Entry[]} */
function objectEntries(answer, classes, name, store, verdicts) {
  return answer.outliers.map((one, index) => {
    const doubtful = isDoubtful(one);
    const title = el('button', {
      type: 'button', class: 'link', 'data-key': `of-${one.object}`, onclick: () => store.set({ selected: one.object }),
    }, name(one.object));
    const flag = one.is_outlier
      ? { kind: 'alarm', buttons: [verdict('Belongs here', name(one.object), () => verdicts.belongs(one.object))] }
      : doubtful ? { unit: ' real' } : { words: confirmedWords(one, name) };
    const group = one.is_outlier ? 'does-not-belong' : doubtful ? 'misdetection' : one.confirmed ? 'confirmed' : 'fits';
    const unsupported = group === 'fits' && index < NEAREST ? el('p', { class: 'quiet reasons' }, 'no other object speaks for it') : null;
    return {
      group, habit: JSON.stringify(aboutOf(one, classes)), words: wordOf(one),
      probability: doubtful ? one.real : one.probability,
      node: row('outliers', title, doubtful ? one.real : one.probability, flag, labelsOf(answer, one) ?? classOf(one),
        // The reasons are about the place in the scene, not about the detector.
        doubtful ? null : reasons(one.because, name, { company: one.usually_with, raised: -1 }) ?? unsupported),
    };
  });
}

/** @returns {Entry[]} */
function placeEntries(answer, classes, name, verdicts) {
  const words = new Map(answer.outliers.map((one) => [one.object, wordOf(one)]));
  const word = (id) => words.get(id) ?? shown(id);
  return answer.misplaced.filter((one) => one.is_misplaced || one.confirmed).map((one) => ({
    group: one.confirmed ? 'confirmed' : one.reason ?? 'relation',
    probability: one.probability, habit: JSON.stringify(aboutOf(one, classes)),
    words: `${word(one.subject)} ${SPOKEN[one.relation]} ${word(one.object)}`,
    node: row('outliers', el('b', {}, spoken(one, name)), one.probability, one.confirmed
      ? { words: confirmedWords(one, name) }
      : { kind: 'alarm', buttons: [verdict('Stands right', spoken(one, name), () => verdicts.standsRight(one))] },
    one.moved == null || one.moved === one.subject ? null : el('p', { class: 'quiet' }, `moved: ${name(one.moved)}`),
    one.confirmed && !isLearnt(one) ? el('p', { class: 'quiet' }, NOT_LEARNT) : null),
  }));
}

/** The rows of alarms, with one fold for each habit of several alarms. */
function byHabit(entries, key, folds) {
  const habits = new Map();
  for (const entry of entries) habits.set(entry.habit, [...(habits.get(entry.habit) ?? []), entry]);
  return [...habits].map(([habit, all]) => (all.length === 1 ? all[0].node : el('li', { class: 'alarm fold' },
    folds.fold(`${key} ${habit}`, `${all.length} × ${all[0].words}, up to ${percent(all[0].probability)}`, el('ol', {}, ...all.map(({ node }) => node))))));
}

/** A group with its first rows; the others are a fold. */
function grouped(kind, entries, key, folds, isQuiet) {
  const isAlarm = ALARMS.includes(kind);
  const nodes = isAlarm && entries.length > MOST_FLAT ? byHabit(entries, key, folds) : entries.map(({ node }) => node);
  const first = entries.length <= MOST_FLAT ? nodes.length : isAlarm ? MOST_ALARMS : isQuiet ? NEAREST : 0;
  const heading = kind === 'fits' && isQuiet ? el('h3', {}, 'Nothing looks wrong. Nearest to an alarm:')
    : el('h3', {}, `${GROUPS[kind] ?? shown(kind)} `, el('span', { class: 'quiet' }, `(${entries.length})`));
  const rest = nodes.slice(first);
  const hidden = rest.length === 1 && first ? [] : rest; // a fold of one row would hide nothing
  const open = nodes.slice(0, nodes.length - hidden.length);
  const words = first ? `${hidden.length} more` : `Show all ${hidden.length}`;
  return el('li', { class: 'group' }, heading, ...(open.length ? [el('ol', {}, ...open)] : []),
    ...(hidden.length ? [folds.fold(`${key} rest`, words, el('ol', {}, ...hidden))] : []));
}

/** The rows of an answer about wrong objects and places. @param {object} folds as `createFolds` returns them */
export function wrongRows(found, name, state, store, column, verdicts, folds) {
  const answer = judgedBy(state.answers[column], state) ?? found;
  const classes = classesOf(answer);
  const entries = [...objectEntries(answer, classes, name, store, verdicts), ...placeEntries(answer, classes, name, verdicts)];
  const groups = Object.groupBy(entries, ({ group }) => group);
  const isQuiet = !entries.some(({ group }) => ALARMS.includes(group) || group === 'misdetection');
  const kinds = [...new Set([...Object.keys(GROUPS), ...Object.keys(groups)])].filter((kind) => groups[kind]);
  const isPlace = (kind) => ALARMS.indexOf(kind) > 0;
  kinds.sort((a, b) => (isPlace(a) && isPlace(b) ? groups[b][0].probability - groups[a][0].probability : 0));
  const stated = state.posed || state.relations.length;
  return [
    ...split(answer, name, store),
    ...kinds.map((kind) => grouped(kind, groups[kind], `${column} ${kind}`, folds, isQuiet)),
    stated ? null : el('li', { class: 'quiet' }, 'Places are not judged, because positions do not count as evidence.'),
  ].filter(Boolean);
}

/** The labels of an object with alternatives, as the other objects decide. */
function labelsOf({ resolved }, { object }) {
  const found = resolved?.find((one) => one.object === object);
  return found ? el('p', { class: 'quiet' }, `labels: ${resolvedWords(found)}`) : null;
}

/** The objects of each room, if they are probably from several rooms. */
function split({ warnings = [] }, name, store) {
  const rooms = warnings.find(({ code }) => code === 'several-rooms')?.rooms ?? [];
  if (!rooms.length) return [];
  const parts = rooms.map(({ room_type: room, objects }) => el('li', {},
    el('div', { class: 'headline' }, el('b', {}, `${room} (${objects.length})`), verdict('Only these', room, () => keepOnly(store, room, objects))),
    el('p', { class: 'quiet' }, some(objects.map(name)))));
  return [el('li', { class: 'rooms' },
    el('p', {}, `The objects are probably from ${rooms.length} rooms, but the answers are about one room.`), el('ul', {}, ...parts))];
}

/** Leaves the objects of one room on the board, as a new scene. Undo brings the others back. */
function keepOnly(store, room, objects) {
  const { things, relations } = store.get();
  const kept = new Set(objects);
  store.edit({
    things: things.filter(({ id }) => kept.has(id)).map(({ source, ...thing }) => thing),
    relations: relations.filter(({ subject, object }) => kept.has(subject) && kept.has(object)),
    room, selected: null, at: null, line: newLine(), right: [],
  });
}

/** Whether adapt learns a confirmed relation (training/domain/home.py). */
const isLearnt = ({ relation, object }) => object !== 'floor' && !['left', 'right', 'front', 'behind'].includes(relation);
const NOT_LEARNT = 'An adapted model reports this again: adapt learns which objects support others, not places on the floor or beside objects.';

