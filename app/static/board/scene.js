/** Conversion between the board and a scene of the API. */

import { halves, radians, round, UNKNOWN_SIZE } from './geometry.js';
import { shown, SPOKEN } from './words.js';

/** @typedef {import('./store.js').Thing} Thing */

/** Adds a size to an object: its own size, the typical size, or a guess. */
export const sizer = (sizes) => (thing) => ({
  ...thing,
  size: thing.size ?? sizes.get(thing.label) ?? UNKNOWN_SIZE,
});

/** An unused id for an object with this label. */
export function freshId(things, label) {
  const taken = new Set(things.map((thing) => thing.id));
  let id = label;
  for (let number = 2; taken.has(id); number += 1) id = `${label}_${number}`;
  return id;
}

/**
 * The scene for a request: labels and stated relations, or with `posed` the positions in their place.
 * Positions that the page chose are left out. Typical and guessed sizes are included, so that all
 * models get the same boxes.
 * @param {{things: Thing[], relations: object[], posed: boolean, viewer: object, room: string}} board
 */
export function toScene({ things, relations, posed, viewer, room }, sizes) {
  const ids = new Set(things.map(({ id }) => id));
  const stated = relations.filter(({ subject, object }) => ids.has(subject) && ids.has(object));
  return {
    objects: things.map((thing) => ({
      id: thing.id,
      label: thing.label,
      ...(thing.confidence < 1 && { confidence: thing.confidence }),
      ...(thing.alternatives && { alternatives: thing.alternatives }),
      ...(posed && thing.placed && poseOf(sizer(sizes)(thing))),
    })),
    ...(!posed && stated.length && { relations: stated }),
    ...(room && { room_type: room }),
    ...(posed && {
      frame_id: 'map', viewpoint: { x: round(viewer.x), y: round(viewer.y), yaw: round(viewer.yaw, 4) },
    }),
  };
}

function poseOf({ x, y, z, yaw, size }) {
  const half = radians(yaw) / 2;
  return {
    position: { x: round(x), y: round(y), z: round(z + size.z / 2) },
    size,
    ...(yaw && { orientation: { x: 0, y: 0, z: round(Math.sin(half), 6), w: round(Math.cos(half), 6) } }),
  };
}

/** Limits of the service: coordinate and extent in metres, heading in radians, number of objects. */
const FARTHEST = 1e8;
const LARGEST = 1e7;
const MOST_TURNED = 1e3;
export const MOST_OBJECTS = 256;
export const FULL = `A scene can have at most ${MOST_OBJECTS} objects. Remove one first.`;

/** An error in a scene, with a message for the user. */
export class SceneError extends Error {}

function fail(condition, words) {
  if (condition) throw new SceneError(words);
}

const SMALLEST = 1e-3; // metres
/** The conventions of the boxes on the board. */
const CONVENTIONS = { up: 'z', units: 'm', extents: 'full', box_origin: 'centre', quaternion_order: 'xyzw' };
const isNumber = (value) => typeof value === 'number' && Number.isFinite(value);
const AXES = ['x', 'y', 'z'];
const isPlace = (value) => isNumber(value) && Math.abs(value) <= FARTHEST;
const isExtent = (value) => isNumber(value) && value >= 0 && value <= LARGEST;

/**
 * Reads a scene of the API.
 * @returns {{things: Thing[], viewer: object, room: string, relations: object[], foreign: string}}
 * @throws {SceneError}
 */
export function fromScene(scene, sizes) {
  fail(!scene || typeof scene !== 'object' || Array.isArray(scene), 'A scene must be a JSON object: {"objects": [...]}.');
  fail(!Array.isArray(scene.objects), 'A scene must have a list "objects".');
  fail(scene.objects.length > MOST_OBJECTS, `A scene can have at most ${MOST_OBJECTS} objects.`);
  const things = [];
  const entries = scene.objects.map(spelledOut);
  const ids = idsOf(entries);
  entries.forEach((entry, index) => things.push(readThing(entry, ids[index], index, things, sizes)));
  // In the optical frame of a camera, x and y have other directions than on the board.
  const optical = /_optical(_frame)?$/.test(scene.frame_id ?? '');
  const declared = Object.entries(CONVENTIONS).some(([name, usual]) => (scene[name] ?? usual) !== usual);
  if (optical || declared) for (const thing of things) thing.placed = false;
  if (declared) for (const thing of things) thing.size = null;
  const { x = 0, y = 0, yaw = 0 } = scene.viewpoint ?? {};
  fail(!(isPlace(x) && isPlace(y)), 'The viewpoint needs numbers x and y within ±100 000 km.');
  fail(!(isNumber(yaw) && Math.abs(yaw) <= MOST_TURNED), 'The viewpoint needs a yaw within ±1000 radians.');
  fail(!Array.isArray(scene.relations ?? []), '"relations" must be a list.');
  const relations = [...(scene.relations ?? []).map(readRelation(things)), ...supports(entries, ids, things)];
  let foreign = optical ? 'The board leaves out positions in the optical frame of a camera.' : '';
  if (declared) foreign = 'The board leaves out boxes with declared conventions, such as other units.';
  const room = scene.room_type ?? '';
  fail(typeof room !== 'string', 'The room type must be a text.');
  return { things, viewer: { x, y, yaw }, room, relations: distinct(relations), foreign };
}

/** An object with vectors as objects, its yaw as a quaternion, and a number as id. */
function spelledOut(entry) {
  if (!entry || typeof entry !== 'object') return entry;
  const named = (value, ...names) =>
    Array.isArray(value) && value.length === names.length ? Object.fromEntries(names.map((name, index) => [name, value[index]])) : value;
  const { id, position, size, orientation, yaw } = entry;
  const turn = isNumber(yaw) ? { x: 0, y: 0, z: Math.sin(yaw / 2), w: Math.cos(yaw / 2) } : orientation;
  return { ...entry, id: asId(id), position: named(position, ...AXES), size: named(size, ...AXES), orientation: named(turn, ...AXES, 'w') };
}

/** A whole number is the id with its digits. */
const asId = (id) => (Number.isInteger(id) ? String(id) : id);

/** The supports of objects as relations, unless the positions of all objects give them. */
function supports(entries, ids, things) {
  if (entries.every((entry) => entry?.position)) return [];
  const stated = entries.flatMap((entry, index) => (entry?.supported_by == null ? [] : [[ids[index], 'on-top', entry.supported_by]]));
  return stated.map(readRelation(things));
}

const distinct = (relations) => [...new Map(relations.map((one) => [JSON.stringify(Object.values(one)), one])).values()];

/** Reads relations, as objects or arrays. Their ends are ids or unambiguous labels. */
function readRelation(things) {
  const names = new Map();
  for (const { id, label } of things) names.set(label, names.has(label) ? null : id);
  for (const { id } of things) names.set(id, id);
  return (found, index) => {
    const where = `Relation ${index + 1}`;
    fail(!found || typeof found !== 'object', `${where} must have a subject, a relation and an object.`);
    const [subject, relation, object] = (Array.isArray(found) ? found : [found.subject, found.relation, found.object]).map(asId);
    fail(!Object.hasOwn(SPOKEN, relation), `${where} must be one of ${Object.keys(SPOKEN).join(', ')}.`);
    for (const name of [subject, object]) {
      fail(!names.has(name), `${where} names an object outside the scene: ${shown(name)}.`);
      fail(names.get(name) === null, `${where} needs an id, because several objects have the label ${shown(name)}.`);
    }
    return { subject: names.get(subject), relation, object: names.get(object) };
  };
}

/** The ids of objects as in the service: a repeated label without an id gets numbers from 1. */
function idsOf(entries) {
  const found = entries.map((entry) => (typeof entry === 'string' ? { label: entry } : entry ?? {}));
  const bare = found.filter(({ id }) => id == null).map(({ label }) => label);
  const taken = new Set(found.map(({ id }) => id).filter((id) => id != null));
  return found.map(({ id, label }) => {
    if (id != null) return id;
    let own = label;
    if (bare.indexOf(label) !== bare.lastIndexOf(label)) taken.add(label);
    for (let number = 1; taken.has(own); number += 1) own = `${label}_${number}`;
    taken.add(own);
    return own;
  });
}

function readThing(entry, id, index, before, sizes) {
  const found = typeof entry === 'string' ? { label: entry } : entry;
  const where = `Object ${index + 1}`;
  fail(!found || typeof found !== 'object', `${where} must be a label or a JSON object.`);
  fail(typeof found.label !== 'string' || !found.label.trim(), `${where} needs a label.`);
  fail(typeof id !== 'string' || !id.trim() || id.startsWith('\u0000'), `${where} has an id that is not a text.`);
  fail(before.some((thing) => thing.id === id), `${where} has the id of another object: ${shown(id)}.`);
  const { position, size: extents, orientation: q } = found;
  const confidence = found.confidence ?? 1;
  fail(position && !AXES.every((axis) => isPlace(position[axis])), `${where} needs a position with numbers x, y, z within ±100 000 km.`);
  fail(extents && !AXES.every((axis) => isExtent(extents[axis])), `${where} needs a size with numbers x, y, z from 0 to 10 000 km.`);
  fail(!(isNumber(confidence) && confidence > 0 && confidence <= 1), `${where} has a confidence outside (0, 1].`);
  fail(q && !([q.x, q.y, q.z, q.w].every(isNumber) && Math.abs(Math.hypot(q.x, q.y, q.z, q.w) - 1) <= 0.01), `${where} has an orientation that is not a quaternion of length 1.`);
  const yaw = q ? (Math.atan2(2 * (q.w * q.z + q.x * q.y), 1 - 2 * (q.y * q.y + q.z * q.z)) * 180) / Math.PI : 0;
  // A box with a short side is flat. A box with short sides alone has an unknown size.
  const size = extents && AXES.some((axis) => extents[axis] >= SMALLEST) ? extents : null;
  const thing = { id, label: found.label, size, yaw: round(yaw, 2), confidence, x: 0, y: 0, z: 0 };
  const height = sizer(sizes)(thing).size.z;
  const at = position && { x: position.x, y: position.y, z: round(position.z - height / 2) };
  const { alternatives } = found;
  return { ...thing, ...at, placed: Boolean(position), ...(alternatives?.length && { alternatives }) };
}

const AROUND = 0.5; // metres that stay free around the robot

/** A free place for a new object: near the centre of the robot's view, else any free place. */
export function freePlace(boxes, size, viewer) {
  const need = halves({ size, yaw: 0 });
  const [c, s] = [Math.cos(viewer.yaw), Math.sin(viewer.yaw)];
  const free = ({ x, y }) =>
    Math.hypot(Math.max(0, Math.abs(x - viewer.x) - need.x), Math.max(0, Math.abs(y - viewer.y) - need.y)) >= AROUND &&
    boxes.every((box) => {
      const half = halves(box);
      const apart = Math.abs(box.x - x) > half.x + need.x + 0.1;
      return apart || Math.abs(box.y - y) > half.y + need.y + 0.1;
    });
  const ahead = ({ x, y }) => (x - viewer.x) * c + (y - viewer.y) * s > 0;
  const places = [];
  for (let ring = 0; ring < 40; ring += 1) {
    for (let step = 0; step < Math.max(1, ring * 6); step += 1) {
      const angle = viewer.yaw + (2 * Math.PI * step) / Math.max(1, ring * 6);
      const [x, y] = [2 * c + ring * 0.3 * Math.cos(angle), 2 * s + ring * 0.3 * Math.sin(angle)];
      places.push({ x: round(viewer.x + x, 1), y: round(viewer.y + y, 1) });
    }
  }
  const found = places.find((place) => ahead(place) && free(place)) ?? places.find(free);
  return found ?? beyond(boxes, need, viewer);
}

/** A place beyond all objects along x. */
function beyond(boxes, need, viewer) {
  const edge = Math.max(viewer.x + AROUND, ...boxes.map((box) => box.x + halves(box).x));
  return { x: round(edge + need.x + 0.1, 1), y: viewer.y };
}
