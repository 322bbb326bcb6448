/**
 * Confirmed scenes, in the format in which the client records scenes (scene_client/recorder.py). The
 * browser keeps the confirmed scenes. The other scenes of an opened file stay in memory.
 */

import { radians, round } from './geometry.js';
import { sizesOf } from './questions.js';
import { sizer } from './scene.js';
import { changed } from './store.js';

const PREFIX = 'confirmed ';
const MOST_SCENES = 1000;
const LEAST_CONFIDENCE = 0.5;
const FULL = 'This browser has no room for more confirmed scenes. Download them, then remove them from the browser.';
const PARTS = ['line', 'things', 'posed', 'viewer', 'room', 'relations'];

/** The line of a scene that comes from no file. */
export function newLine(now = new Date()) {
  const two = (value) => String(value).padStart(2, '0');
  const hour = `${now.getFullYear()}-${two(now.getMonth() + 1)}-${two(now.getDate())}T${two(now.getHours())}`;
  const random = Array.from(crypto.getRandomValues(new Uint8Array(8)), (byte) => byte.toString(16).padStart(2, '0'));
  const seconds = Math.floor(now.getTime() / 1000);
  return { scene_id: `${hour}-${random.join('')}`, group: hour, stamp: { sec: seconds, nanosec: (now.getTime() % 1000) * 1e6 } };
}

/** The scenes of a file as recorded scenes, or [] for another file. A scene without id is named as in the training. */
export function linesOf(scenes, file) {
  const lines = scenes.map(({ name, scene }) => ({ scene_id: `${file}:${name}`, ...scene }));
  const isRecording = lines.length > 1 || scenes[0].scene.scene_id;
  return isRecording && lines.every(({ objects }) => Array.isArray(objects)) ? lines : [];
}

/** Remembers the objects of a line at the objects of the board. Unchanged objects stay as they are in the file. */
export const withSources = (things, { objects = [] }) => things.map((thing, index) => (
  objects.length === things.length ? { ...thing, source: { entry: objects[index], before: thing } } : thing));

/** The scene of the board as a line of the file. Positions of a line from a file stay in its own axes. */
export function lineOf(state) {
  const { line, things, room } = state;
  const kept = things.filter(({ source, confidence }) => source || confidence >= LEAST_CONFIDENCE);
  const entries = line.objects ? kept.map((thing) => ownEntry(thing, state)) : newEntries(kept, state);
  const names = new Set(kept.flatMap(({ label }, index) => [label, entries[index].id].filter((name) => name != null)));
  const objects = entries.map(({ supported_by: support, ...entry }) => (
    support != null && names.has(support) ? { ...entry, supported_by: support } : entry));
  const result = { ...line, ...(room && { room_type: room }), objects };
  if (!room) delete result.room_type;
  for (const name of ['relations', 'false_relations'].filter((one) => line[one])) {
    result[name] = line[name].filter((one) => ends(one).every((end) => names.has(end)));
  }
  if (!line.objects && objects.some(({ position }) => position)) result.viewer_frame = true;
  return result;
}

const ends = (one) => (Array.isArray(one) ? [one[0], one[2]] : [one.subject, one.object]);

/** An object of a line from a file. */
function ownEntry(thing, state) {
  const { id, label, source, placed } = thing;
  const at = () => placed && pose(thing, state, { x: 0, y: 0, yaw: 0 });
  if (!source) {
    const taken = new Set(state.things.map((other) => other.source?.entry.id));
    return { id: taken.has(id) ? `${id}_new` : id, label, ...at() };
  }
  const { entry: { alternatives, ...entry }, before } = typeof source.entry === 'string' ? { ...source, entry: { id } } : source;
  const moved = ['x', 'y', 'z', 'yaw', 'size'].some((name) => thing[name] !== before[name]);
  return { ...entry, ...(alternatives && thing.alternatives && { alternatives }), label, ...(moved && at()) };
}

/** The objects of a new scene, in the axes of the robot. */
function newEntries(things, state) {
  const supports = new Map(state.relations.flatMap(({ subject, relation, object }) => (
    relation === 'on-top' ? [[subject, object]] : relation === 'under' ? [[object, subject]] : [])));
  return things.map((thing) => ({
    id: thing.id, label: thing.label, ...(state.posed && thing.placed && pose(thing, state, state.viewer)),
    ...(!state.posed && { supported_by: supports.get(thing.id) }),
  }));
}

/** Position, size and rotation of an object in the axes of a viewer. */
function pose(thing, state, { x, y, yaw }) {
  const height = sizer(sizesOf(state, state.models[0]))(thing).size.z;
  const [c, s] = [Math.cos(yaw), Math.sin(yaw)];
  const [dx, dy] = [thing.x - x, thing.y - y];
  const turn = round(radians(thing.yaw) - yaw, 4);
  return {
    position: [dx * c + dy * s, dy * c - dx * s, thing.z + height / 2].map((value) => round(value, 4)),
    ...(thing.size && { size: AXES.map((axis) => thing.size[axis]) }),
    ...(turn && { yaw: turn }),
  };
}

const AXES = ['x', 'y', 'z'];

/**
 * Keeps the confirmed scenes of the board.
 * @param {() => void} whenChanged
 * @param {{keep: (line: object) => void, drop: (id: string) => void}} sender gets each scene that the user confirms
 */
export function createRecords(store, whenChanged, sender) {
  const confirmed = new Map(stored()); // scene_id → {line, of}; of: the first scene_id of the opened file, or ''
  let file = new Map();
  let name = 'scenes.jsonl';
  const opened = () => file.keys().next().value ?? '';

  function keep(line) {
    if (confirmed.size >= MOST_SCENES && !confirmed.has(line.scene_id)) {
      store.set({ complaint: FULL });
      return;
    }
    const entry = { line, of: confirmed.get(line.scene_id)?.of ?? opened() };
    confirmed.set(line.scene_id, entry);
    sender.keep(line);
    try {
      localStorage.setItem(PREFIX + line.scene_id, JSON.stringify(entry));
    } catch {
      store.set({ complaint: FULL }); // or the browser forbids storage; the scene stays in memory
    }
  }

  function drop(id) {
    confirmed.delete(id);
    sender.drop(id);
    forget([id]);
  }

  store.subscribe((state, previous) => {
    if (!state.line || !changed(state, previous, ...PARTS)) return;
    const isSame = state.line.scene_id === previous.line?.scene_id;
    if (isSame && state.line.confirmed) keep(lineOf(state));
    else if (isSame && previous.line.confirmed && !state.line.confirmed) drop(state.line.scene_id); // undone
    else return;
    whenChanged();
  });

  return {
    /** The name of the opened file. */
    name: () => name,
    /** The number of confirmed scenes of the opened file, with those that were drawn since. */
    count: () => [...lines().values()].filter((line) => line.confirmed).length,
    /** The number of confirmed scenes of other files. */
    others: () => [...confirmed.keys()].filter((id) => !lines().has(id)).length,
    /** The confirmed scene with the id of a line, or the line. */
    current: (line) => confirmed.get(line.scene_id)?.line ?? line,
    /** The number of scenes that this browser keeps. */
    kept: () => confirmed.size,
    /** Replaces the opened file by that of the name `of`. Returns its lines, with the confirmed scenes of this browser. */
    open(found, of) {
      file = new Map(found.map((line) => [line.scene_id, line]));
      name = of.replace(/\.json$/, '.jsonl');
      whenChanged();
      return found.map(this.current);
    },
    text: () => [...lines().values()].map((line) => `${JSON.stringify(line)}\n`).join(''),
    clear() {
      forget(confirmed.keys());
      confirmed.clear();
      whenChanged();
    },
  };

  function lines() {
    const all = new Map(file);
    for (const [id, { line, of }] of confirmed) if (file.has(id) || of === opened()) all.set(id, line);
    return all;
  }
}

/** The confirmed scenes that the browser keeps. */
function stored() {
  try {
    return Object.keys(localStorage).filter((key) => key.startsWith(PREFIX)).sort()
      .map((key) => [key.slice(PREFIX.length), JSON.parse(localStorage.getItem(key))]);
  } catch {
    return []; // The browser forbids storage.
  }
}

function forget(ids) {
  try {
    for (const id of ids) localStorage.removeItem(PREFIX + id);
  } catch {
    // See above.
  }
}
