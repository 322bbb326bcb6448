/** Detections in the layout of vision_msgs, which the readers of file formats return. */

import { number } from './detections.js';

export const NO_TURN = [0, 0, 0, 1];

/** A detection with a class (label or id), a score, an id, a frame and a box. */
export const detection = (label, score, name, box, frame = '') => ({
  header: { frame_id: frame }, id: name, results: [{ class_id: label, score }], ...box,
});

/** A box in an image, by its centre, its size and its rotation in radians. */
export const imageBox = (x, y, width, height, theta = 0) => ({
  bbox: { center: { x, y, theta }, size_x: width, size_y: height },
});

function span(values) {
  const found = values.map(number);
  if (!found.length || found.includes(null)) return [NaN, NaN];
  return [found.reduce((a, b) => Math.min(a, b)), found.reduce((a, b) => Math.max(a, b))];
}

/** The box around points of an image. */
export function boxBetween(xs, ys, theta = 0) {
  const [[left, right], [top, bottom]] = [span(xs), span(ys)];
  return imageBox((left + right) / 2, (top + bottom) / 2, right - left, bottom - top, theta);
}

function named(names, values) {
  if (values == null) return null;
  if (values.length !== names.length) throw new TypeError('a vector has another length');
  return Object.fromEntries([...names].map((name, index) => [name, values[index]]));
}

/** A box in metres; each value is a list or null. */
export const solidBox = (centre, size, turn = NO_TURN) => ({
  bbox: { center: { position: named('xyz', centre), orientation: named('xyzw', turn) }, size: named('xyz', size) },
});

/** A finite number. @throws {TypeError} */
export function must(value) {
  if (number(value) === null) throw new TypeError('a value is not a finite number');
  return value;
}

/** The rotation about the z axis by an angle in radians. */
export const turnOf = (yaw) => [0, 0, Math.sin(yaw / 2), Math.cos(yaw / 2)];

/** The values of an object {x, y, z}; lists unchanged. */
export const vector = (value) => (value == null || Array.isArray(value) ? value : [value.x, value.y, value.z]);

/** A note that the scene leaves entries out. */
export const excluded = (count, what) => (count ? [[null, 'excluded', `the scene leaves out ${count} ${what}`]] : []);

export const radians = (degrees) => (must(degrees) * Math.PI) / 180;
