/** The places and rooms of one thing as rows, and the searches as chips. */

import { el } from './dom.js';
import { row, verdict } from './rows.js';
import { isOnBoard, placesOf, thingAt } from './spots.js';
import { namesOf, percent, shown, SPOKEN } from './words.js';

const MOST_ROOMS = 6; // shown rooms, likeliest first

/** The name of an object of a room. */
function nameIn({ room, object }, { rooms }) {
  const { objects = [] } = rooms.find((one) => one.name === room) ?? {};
  return namesOf(objects)(object);
}

/** @param {object} where the part `where` of the state */
export function placeWords(place, where) {
  const room = shown(place.room);
  if (place.is_listed) return `${room}: ${nameIn(place, where)}, seen there`;
  return `${room}: ${place.object == null ? 'elsewhere' : `${SPOKEN[place.relation]} ${nameIn(place, where)}`}`;
}

const isSame = (a, b) => a.room === b.room && a.object === b.object && a.relation === b.relation && a.is_listed === b.is_listed;

/** The probability of an entry before the last search; null if it is the same or unknown. */
function formerly(entries, entry, same) {
  const was = entries?.find((one) => same(one, entry))?.probability;
  return was === undefined || percent(was) === percent(entry.probability) ? null : was;
}

/** @param {{show: (place: object) => void, look: (place: object) => void}} act */
function placeRow(place, state, act) {
  const { rooms, searched, before } = state.where;
  const words = placeWords(place, state.where);
  const canShow = thingAt(place, state) || rooms.find((one) => one.name === place.room)?.index !== undefined;
  const title = canShow
    ? el('button', { type: 'button', class: 'link', 'data-key': `show ${words}`, onclick: () => act.show(place) }, words)
    : el('b', {}, words);
  const looks = searched.filter(({ room, object }) => room === place.room && (object == null || object === place.object)).length;
  const button = verdict(place.object == null ? 'Looked in the room' : 'Looked there', words, () => act.look(place));
  return row('missing', title, place.probability, {
    words: looks ? `looked${looks > 1 ? ` ${looks}\u00a0times` : ''}` : '', was: formerly(before?.places, place, isSame), buttons: [button],
  });
}

export const placeRows = (state, act) => placesOf(state.where).map((place) => placeRow(place, state, act));

/** @param {(room: import('./spots.js').Room) => void} show puts a room of the file on the board */
export function roomRows(state, show) {
  const { answer, before, rooms } = state.where;
  if (!answer) return [];
  const known = new Map(rooms.map((room) => [room.name, room]));
  const first = answer.rooms.slice(0, answer.rooms.length > MOST_ROOMS + 1 ? MOST_ROOMS : answer.rooms.length);
  const others = answer.rooms.slice(first.length);
  const sum = others.reduce((total, { probability }) => total + probability, 0);
  const rowOf = (one) => {
    const room = known.get(one.room);
    const onBoard = room && isOnBoard(room, state);
    const words = shown(one.room);
    const title = room?.index === undefined || onBoard ? el('b', {}, words) : el('button', {
      type: 'button', class: 'link', 'data-key': `room ${one.room}`, 'aria-label': `Show ${words} on the board`, onclick: () => show(room),
    }, words);
    const was = formerly(before?.rooms, one, (a, b) => a.room === b.room);
    return row('relations', title, one.probability, { words: onBoard ? 'on the board' : '', was });
  };
  const outside = { probability: answer.not_here };
  return [
    ...first.map(rowOf),
    ...(others.length ? [row('relations', el('b', {}, `${others.length} other rooms`), sum, {})] : []),
    row('relations', el('b', {}, 'not here'), answer.not_here, { was: formerly(before && [{ probability: before.not_here }], outside, () => true) }),
  ];
}

/** A chip for each search, with a button that takes it back. */
export const searchChips = ({ where }, takeBack) => where.searched.map((one, index) => {
  const words = `${shown(one.room)}: ${one.object == null ? 'the whole room' : nameIn(one, where)}`;
  return el('li', {}, words, el('button', {
    type: 'button', class: 'icon', 'data-key': `back ${index}`, 'aria-label': `Take back the search: ${words}`, onclick: () => takeBack(index),
  }, '✕'));
});

/** The probabilities of the room on the board, in words; '' for another board. */
export function hereWords(state) {
  const { answer, rooms } = state.where;
  const room = state.tab === 'where' && answer && !state.draft && rooms.find((one) => isOnBoard(one, state));
  if (!room) return '';
  const share = answer.rooms.find((one) => one.room === room.name)?.probability ?? 0;
  const rest = answer.places.find((place) => place.room === room.name && place.object == null)?.probability;
  const elsewhere = rest === undefined ? '' : ` At no listed object: ${percent(rest)}.`;
  return `${shown(state.where.wanted)} in this room: ${percent(share)}.${elsewhere}`;
}
