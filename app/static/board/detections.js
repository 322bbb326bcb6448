/**
 * Converts detections in the layout of vision_msgs to a scene of the API. Every reader of a file
 * format returns such detections. The Python module `scene_client.vision_msgs` does the same; tests
 * hold the two together.
 *
 * @typedef {{detections: object[], header?: object, viewpoint?: object, notes?: Note[]}} Message
 * @typedef {[number | null, string, string]} Note index of a detection, code of a reason, the reason in words
 * @typedef {Map<string, string | null>} Labels labels of class ids
 */

import { leftPairs, uprightBox } from './image_plane.js';
import { MOST_OBJECTS, SceneError } from './scene.js';

const MOST_RELATIONS = 4096;
const [LONGEST_LABEL, LONGEST_ID, LONGEST_FRAME] = [100, 128, 256];
const [FARTHEST, LARGEST] = [1e8, 1e4]; // metres
const SHORTEST = 1e-6; // a shorter quaternion is unset

export const REMEDY = 'Choose “Labels of numeric class ids”.';

export const number = (value) => (typeof value === 'number' && Number.isFinite(value) ? value : null);

/** A text, or a whole number as text. */
export const text = (value) => (typeof value === 'string' ? value.trim() : Number.isInteger(value) ? String(BigInt(value)) : '');

/** The numbers in fields with one-letter names, or null if one is not finite. */
export function numbers(value, names) {
  const found = [...names].map((name) => number(value?.[name]));
  return found.includes(null) ? null : Object.fromEntries([...names].map((name, index) => [name, found[index]]));
}

export const frameOf = (header) => (typeof header?.frame_id === 'string' ? header.frame_id.trim().replace(/^\/+/, '') : '');

const UNPRINTABLE = /[\p{C}\p{Zl}\p{Zp}]|(?! )\p{Zs}/u;
const isPlain = (value, longest) => value !== '' && [...value].length <= longest && !UNPRINTABLE.test(value);
const isNumber = (label) => /^-?\p{Nd}+$/u.test(label);

/** A message of ROS without the envelope of rosbridge. */
export const unwrapped = (message) => (isObject(message?.msg) ? message.msg : message);
export const isObject = (value) => value !== null && typeof value === 'object' && !Array.isArray(value);

/** A DetectionArray of yolo_ros in the layout of vision_msgs; other messages unchanged. */
function asVisionMsgs(message) {
  const entries = message.detections;
  if (!entries.some((entry) => isObject(entry) && 'class_name' in entry)) return message;
  const isSolid = entries.some((entry) => Object.values(numbers(entry?.bbox3d?.size, 'xyz') ?? {}).some(Boolean));
  const frames = entries.map((entry) => (isSolid ? frameOf(entry?.bbox3d) : ''));
  const flat = (box) => ({ center: box?.center, size_x: box?.size?.x, size_y: box?.size?.y });
  return {
    header: { frame_id: frames.find(Boolean) ?? frameOf(message.header), stamp: message.header?.stamp },
    detections: entries.map((entry, index) => ({
      header: { frame_id: frames[index] },
      id: entry?.id,
      results: [{ class_id: text(entry?.class_name) || entry?.class_id, score: entry?.score }],
      bbox: isSolid ? entry?.bbox3d : flat(entry?.bbox),
    })),
  };
}

/**
 * @param {Message} given
 * @param {Labels | null} labels
 * @returns {{scene: object, notes: Note[]}}
 * @throws {SceneError}
 */
export function fromMessage(given, labels) {
  if (!Array.isArray(given.detections)) throw new SceneError('“detections” must be a list.');
  const message = asVisionMsgs(given);
  const notes = [];
  const note = (...entry) => notes.push(entry);
  const seen = message.detections.map((one, index) => sighting(one, index, labels, note)).filter(Boolean);
  if (!seen.length && !labels && areNumbers(message.detections, notes)) {
    throw new SceneError(`The class ids are numbers. ${REMEDY}`);
  }
  const sightings = mostConfident(seen, note);
  const ids = idsOf(sightings, note);
  const frame = [message.header, ...sightings.map(({ one }) => one.header)].map(frameOf).find(Boolean);
  if (frame && !isPlain(frame, LONGEST_FRAME)) throw new SceneError('frame_id is not plain text.');
  const isFlat = message.detections.some((one) => isObject(one?.bbox) && 'size_x' in one.bbox);
  const objects = sightings.map((thing, index) => ({
    id: ids[index], label: thing.label, confidence: thing.confidence, ...(!isFlat && poseOf(thing, frame, note)),
  }));
  const stamp = message.header?.stamp;
  const time = timeOf(stamp);
  if (stamp != null && !time) note(null, 'no-stamp', 'the stamp of the message is not a valid time');
  const scene = {
    objects,
    ...(isFlat && { relations: imageRelations(sightings, ids, frame, note) }),
    ...(given.viewpoint && { viewpoint: given.viewpoint }),
    unknown_labels: 'nearest-or-ignore',
    ...(frame && { frame_id: frame }),
    ...(time && { stamp: time }),
  };
  notes.sort(([first], [second]) => (first ?? -1) - (second ?? -1));
  return { scene, notes: [...(given.notes ?? []), ...notes] };
}

const hypothesisOf = (result) => result?.hypothesis || result;
const classOf = (hypothesis) => text(hypothesis?.class_id) || text(hypothesis?.id);

function resultsOf(one) {
  const results = one?.results ?? [];
  if (!Array.isArray(results)) throw new SceneError('“results” must be a list.');
  return results;
}

/** The detection with the label and the score of its best hypothesis, or null with a note. */
function sighting(one, index, labels, note) {
  let [best, classId, score] = [null, '', -Infinity];
  for (const result of resultsOf(one)) {
    const own = number(hypothesisOf(result)?.score);
    if (own !== null && own > score) [best, classId, score] = [result, classOf(hypothesisOf(result)), own];
  }
  if (!best) return note(index, 'no-hypothesis', 'the detection has no hypothesis with a score'), null;
  if (!(score > 0)) return note(index, 'low-score', 'the score is not positive'), null;
  const label = labels?.has(classId) ? labels.get(classId) : classId;
  if (label === null) return note(index, 'unwanted', `the label map excludes class '${classId}'`), null;
  if (isNumber(label) || !isPlain(label.trim(), LONGEST_LABEL)) {
    return note(index, 'no-label', `class '${classId.slice(0, LONGEST_LABEL)}' has no label`), null;
  }
  if (score > 1) note(index, 'high-score', 'the score is above 1 and counts as 1');
  return { index, one, label: label.trim(), confidence: Math.min(1, score), pose: best.pose?.pose || best.pose };
}

/** Whether all class ids are numbers, and at least one has no label. */
function areNumbers(detections, notes) {
  const isEach = (one) => resultsOf(one).every((result) => isNumber(classOf(hypothesisOf(result))));
  return notes.some(([, reason]) => reason === 'no-label') && detections.every(isEach);
}

function mostConfident(sightings, note) {
  if (sightings.length <= MOST_OBJECTS) return sightings;
  const ranked = [...sightings].sort((a, b) => b.confidence - a.confidence);
  for (const { index } of ranked.slice(MOST_OBJECTS)) {
    note(index, 'too-many', `${MOST_OBJECTS} other detections have equal or higher scores`);
  }
  return ranked.slice(0, MOST_OBJECTS).sort((a, b) => a.index - b.index);
}

/** The detectors' own ids where they are unique, else labels with numbers. */
function idsOf(sightings, note) {
  const owners = new Map();
  const ids = sightings.map(({ one, index }) => {
    const name = text(one.id) || text(one.tracking_id);
    if (!name) return '';
    if (!isPlain(name, LONGEST_ID)) return note(index, 'renamed', 'the id is not plain text'), '';
    if (owners.has(name)) return note(index, 'renamed', `detection ${owners.get(name)} has the same id`), '';
    owners.set(name, index);
    return name;
  });
  const last = new Map();
  return ids.map((id, place) => {
    const { label } = sightings[place];
    for (let name = id; ; name = `${label}_${last.get(label)}`) {
      if (name && (id || !owners.has(name))) return name;
      last.set(label, (last.get(label) ?? 0) + 1);
    }
  });
}

const isForeign = ({ one }, frame) => !['', frame].includes(frameOf(one.header));

function isUnset(pose) {
  const at = numbers(pose?.position, 'xyz');
  return pose?.position == null || (at !== null && !at.x && !at.y && !at.z);
}

/** Position, size and orientation of a detection, as far as known. */
function poseOf(thing, frame, note) {
  const { one, index } = thing;
  if (isForeign(thing, frame)) return note(index, 'no-position', 'the detection has another frame than the message'), {};
  const sides = numbers(one.bbox?.size, 'xyz');
  const isSized = sides && Object.values(sides).some(Boolean) && Object.values(sides).every((side) => side >= 0 && side <= LARGEST);
  let pose = one.bbox?.center;
  if (!isSized && isUnset(pose)) {
    pose = thing.pose;
    if (isUnset(pose)) {
      if (one.bbox != null || pose != null) note(index, 'no-position', 'the box and the pose are unset');
      return {};
    }
  }
  const position = numbers(pose?.position, 'xyz');
  if (!position || Object.values(position).some((value) => Math.abs(value) > FARTHEST)) {
    return note(index, 'no-position', 'the position is not finite or out of range'), {};
  }
  const turn = numbers(pose.orientation, 'xyzw') ?? {};
  const length = Math.hypot(...Object.values(turn));
  const isTurned = length > SHORTEST && length < Infinity;
  const unit = Object.fromEntries(Object.entries(turn).map(([axis, value]) => [axis, value / length]));
  return { position, ...(isSized && { size: sides }), ...(isTurned && { orientation: unit }) };
}

/** The relations left between neighbouring boxes in the image. */
function imageRelations(sightings, ids, frame, note) {
  const boxes = sightings.map((thing) => imageBox(thing, frame, note));
  const order = ids.map((_, index) => index).sort((a, b) => sightings[b].confidence - sightings[a].confidence);
  const pairs = leftPairs(boxes, order);
  if (pairs.length > MOST_RELATIONS) note(null, 'too-many', `the request leaves out ${pairs.length - MOST_RELATIONS} relations`);
  const kept = pairs.slice(0, MOST_RELATIONS).sort(([a, b], [c, d]) => a - c || b - d);
  return kept.map(([first, second]) => ({ subject: ids[first], relation: 'left', object: ids[second] }));
}

/** The smallest upright box around the box of a detection, which may be rotated. */
function imageBox(thing, frame, note) {
  const { one, index } = thing;
  if (isForeign(thing, frame)) return note(index, 'no-box', 'the detection has another frame than the message'), null;
  const centre = one.bbox?.center;
  const middle = numbers(centre?.position || centre, 'xy');
  const [width, height] = [number(one.bbox?.size_x), number(one.bbox?.size_y)];
  if (!middle || width === null || height === null) return note(index, 'no-box', 'the box is not finite'), null;
  if (!(width > 0 && height > 0)) return note(index, 'no-box', 'the box must have a positive width and height'), null;
  return uprightBox([middle.x, middle.y], [width, height], number(centre.theta) ?? 0);
}

/** A time of ROS 1 or ROS 2 as the field `stamp`; null if it is invalid. */
function timeOf(stamp) {
  for (const names of [['sec', 'nanosec'], ['secs', 'nsecs']]) {
    const [sec, nanosec] = names.map((name) => stamp?.[name]);
    if (Number.isInteger(sec) && Number.isInteger(nanosec)) {
      return Math.abs(sec + 0.5) < 2 ** 31 && nanosec >= 0 && nanosec < 1e9 ? { sec, nanosec } : null;
    }
  }
  return null;
}
