/**
 * Reads the texts that the command `scene` and the training read: a request, a list of objects or of
 * labels, a ROS message with detections as JSON (with or without the envelope of rosbridge), or JSON
 * lines of scenes.
 */

import { SceneError } from './scene.js';

/**
 * @returns {object[]} the scenes in the format of the API; several only from JSON lines
 * @throws {SceneError | SyntaxError}
 */
export function scenesIn(source) {
  if (isLabels(source)) return [{ objects: source.split(/[,\n]/).map((label) => label.trim()).filter(Boolean) }];
  const text = source.replace(NOT_FINITE, (part) => (part[0] === '"' ? part : 'null'));
  try {
    return [sceneOf(JSON.parse(text))];
  } catch (error) {
    const lines = text.split('\n').filter((line) => line.trim());
    if (!(error instanceof SyntaxError) || lines.length < 2 || !lines[0].trim().endsWith('}')) throw error;
    return lines.map((line) => sceneOf(JSON.parse(line)));
  }
}

// Texts, and the numbers that JSON lacks. Detectors write such numbers, for example as covariances.
const NOT_FINITE = /"(?:[^"\\]|\\.)*"|-?\b(?:NaN|Infinity)\b/g;

/** Whether a text consists of labels, with commas or line ends between them, instead of JSON. */
const isLabels = (text) => !/[{}[\]":]/.test(text) && /\p{L}/u.test(text);

function sceneOf(found) {
  try {
    return converted(found);
  } catch (error) {
    throw error instanceof TypeError ? new SceneError('The text is neither a scene nor a message with detections.') : error;
  }
}

function converted(found) {
  const message = found?.msg ?? found;
  if (Array.isArray(message?.detections)) return detected(message);
  if (Array.isArray(found)) return { objects: found };
  return found?.objects?.some?.(({ id, position }) => typeof id === 'number' || Array.isArray(position)) ? annotated(found) : found;
}

const metres = (vector) => (Array.isArray(vector) ? { x: vector[0], y: vector[1], z: vector[2] } : vector);

/** A scene in the format of the training: numbers as ids, lists as vectors, relations as triples. */
function annotated({ objects, relations, room_type: room }) {
  const name = ({ id, label }) =>
    objects.filter((other) => other.label === label).length > 1 ? `${label}_${id}` : label;
  const names = new Map(objects.map((thing) => [thing.id, name(thing)]));
  const positions = objects.every(({ position }) => position);
  const supports = objects.filter((thing) => thing.supported_by != null).map((thing) => [thing.id, 'on-top', thing.supported_by]);
  const stated = new Map([...(relations ?? []), ...supports].map((one) => [String(one), one]));
  return {
    objects: objects.map(({ label, position, size, yaw = 0, ...thing }) => ({
      id: names.get(thing.id), label,
      ...(position && { position: metres(position), ...(size && { size: metres(size) }), orientation: turned(yaw) }),
    })),
    ...(stated.size && !positions && {
      relations: [...stated.values()].map(([subject, relation, object]) => ({ subject: names.get(subject), relation, object: names.get(object) })),
    }),
    ...(room && { room_type: room }),
  };
}

const turned = (yaw) => ({ x: 0, y: 0, z: Math.sin(yaw / 2), w: Math.cos(yaw / 2) });

/** A vision_msgs/Detection3DArray, or the labels of a Detection2DArray. */
function detected({ header, detections }) {
  const seen = detections.map((one) => ({ ...one, best: best(one.results ?? []) })).filter(({ best: { label } }) => label);
  if (!seen.length) throw new SceneError('The message has no detection with a class and a positive score.');
  if (seen.every(({ best: { label } }) => /^-?\d+$/.test(label))) {
    throw new SceneError('The class ids are numbers. The command `scene` translates them with --label-map.');
  }
  const ids = new Map();
  return {
    objects: seen.map((one) => {
      const { label, score } = one.best;
      const own = one.id || one.tracking_id;
      let id = own && !ids.has(own) ? own : '';
      for (let number = 1; !id || ids.has(id); number += 1) id = `${label}_${number}`;
      ids.set(id, true);
      return { id, label, confidence: Math.min(1, score), ...box(one, header) };
    }),
    ...(header?.frame_id && { frame_id: header.frame_id.replace(/^\//, '') }),
  };
}

function best(results) {
  const rated = results.map((one) => ({ ...(one.hypothesis ?? one), pose: one.pose?.pose ?? one.pose })).filter(({ score }) => score > 0);
  const { class_id: label, id, score, pose } = rated.sort((a, b) => b.score - a.score)[0] ?? {};
  return { label: String(label ?? id ?? '').trim(), score, pose };
}

const isSet = (pose) => {
  const { x, y, z } = pose?.position ?? {};
  return [x, y, z].every(Number.isFinite) && Boolean(x || y || z);
};

/** Position, size and orientation of a detection, as far as the message has them in its own frame. */
function box({ bbox, header: own, best: { pose } }, header) {
  if (own?.frame_id && header?.frame_id && own.frame_id !== header.frame_id) return {};
  const sides = bbox?.size && [bbox.size.x, bbox.size.y, bbox.size.z];
  const sized = sides?.every((side) => side >= 0) && sides.some(Boolean);
  const found = sized || isSet(bbox?.center) ? bbox.center : pose;
  if (!found?.position || !(sized || isSet(found))) return {};
  const { position, orientation: q } = found;
  const length = q ? Math.hypot(q.x, q.y, q.z, q.w) : 0;
  return {
    position,
    ...(sized && { size: bbox.size }),
    ...(length > 1e-6 && { orientation: { x: q.x / length, y: q.y / length, z: q.z / length, w: q.w / length } }),
  };
}
