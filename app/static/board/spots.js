/** The question where a thing is, as a part of the state, and its places on the board. */

import { plain } from './words.js';

/**
 * @typedef {object} Room
 * @property {string} name
 * @property {string} [room_type] if the name is none
 * @property {object[]} objects as in a request
 * @property {string} [scene_id] the scene on the board that has these objects
 * @property {number} [index] its number in the opened file
 */

/** The state before the first question; `before` is the answer before the last search. @returns {{rooms: Room[], wanted: string, searched: object[]}} */
export const nowhere = () => ({ rooms: [], wanted: '', searched: [], answer: null, before: null, problem: null, status: 'none', body: null });

/** Whether the board shows this room: its scene, or another scene of the same room of the file. */
export const isOnBoard = (room, { line }) => room.scene_id === line.scene_id
  || (room.index !== undefined && plain(line.room_type ?? '') === plain(room.name));

/** The object of the board at a place of the answer, or undefined. */
export function thingAt({ room: name, object: id }, state) {
  const room = state.where.rooms.find((one) => one.name === name);
  if (id == null || !room || !isOnBoard(room, state)) return undefined;
  const entry = room.objects.find((one) => one.id === id);
  return state.things.find((thing) => thing.id === id && thing.label === entry?.label);
}

const LEAST = 0.01;
const FEWEST = 5;
const MOST = 10;

/** The listed places: those of at least 1 %, and the first ones. */
export const placesOf = ({ answer }) => (answer?.places ?? []).slice(0, MOST)
  .filter(({ probability }, index) => index < FEWEST || probability >= LEAST);

/**
 * The objects of the board that are places of the thing, by id. An object has the sum of its places, such as in and under it.
 * @returns {Map<string, number>} probabilities of at least 1 %
 */
export function spotsOf(state) {
  const shares = new Map();
  if (state.tab !== 'where' || state.draft) return shares;
  for (const place of state.where.answer?.places ?? []) {
    const id = thingAt(place, state)?.id;
    if (id !== undefined) shares.set(id, (shares.get(id) ?? 0) + place.probability);
  }
  return new Map([...shares].filter(([, share]) => share >= LEAST));
}

/** The ids of the objects of the board where the thing was searched, also in a search of the whole room. */
export function searchedOf(state) {
  if (state.tab !== 'where' || state.draft) return new Set();
  return new Set(state.where.searched.flatMap(({ room: name, object }) => {
    const { objects = [] } = state.where.rooms.find((room) => room.name === name) ?? {};
    const ids = object == null ? objects.map(({ id }) => id) : [object];
    return ids.flatMap((id) => thingAt({ room: name, object: id }, state)?.id ?? []);
  }));
}
