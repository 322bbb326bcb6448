/** Readers of formats with boxes in images, as in the Python module `scene_client.image_formats`. */

import { isObject, number, text } from './detections.js';
import { SceneError } from './scene.js';
import { boxBetween, detection, excluded, imageBox, must, radians } from './sightings.js';
import { XmlElement } from './xml.js';

/** Whether a value is a non-empty list of objects that have all these names. */
export const areObjects = (data, ...names) =>
  Array.isArray(data) && data.length > 0 && data.every((one) => isObject(one) && names.every((name) => name in one));

export const hasList = (data, name) => isObject(data) && Array.isArray(data[name]);

/** Adds an entry to the list of a scene. */
export function collect(parts, name, entry) {
  if (!parts.has(name)) parts.set(name, []);
  parts.get(name).push(entry);
}

const COCO = {
  name: 'COCO',
  matches: (data) => (hasList(data, 'annotations') && ('images' in data || 'categories' in data)) || areObjects(data, 'category_id'),
  parts(data) {
    const names = new Map((data.categories ?? []).map(({ id, name }) => [String(id), name]));
    const parts = new Map();
    for (const entry of data.annotations ?? data) collect(parts, String(entry.image_id ?? ''), entry);
    return new Map([...parts].map(([image, entries]) => [image, { entries, names }]));
  },
  read({ entries, names }) {
    if (!entries.every((entry) => 'category_id' in entry)) {
      throw new SceneError('COCO captions and panoptic segments have no boxes: use the file instances_….json.');
    }
    const single = entries.filter(({ iscrowd }) => iscrowd !== 1 && iscrowd !== true);
    return {
      detections: single.map(({ category_id: kind, score = 1, bbox }) =>
        detection(names.get(String(kind)) ?? kind, score, '', cornerBox(bbox ?? [null, null, null, null]))),
      notes: excluded(entries.length - single.length, 'boxes around crowds'),
    };
  },
};

/** The box with a corner, a width and a height. */
function cornerBox(values) {
  if (values.length !== 4) throw new TypeError('a box has not four numbers');
  const [x, y, width, height] = values.map((value) => number(value) ?? NaN);
  return imageBox(x + width / 2, y + height / 2, width, height);
}

/** @throws {TypeError} */
export function fail() {
  throw new TypeError('a value has another type');
}

const tracked = (name, track) => (text(track) ? `${text(name)}_${text(track)}` : '');

const ULTRALYTICS = {
  name: 'Ultralytics',
  matches(data) {
    const isBatch = Array.isArray(data) && data.every(Array.isArray);
    const results = isBatch ? data.filter((one) => one.length) : [data];
    return results.length > 0 && results.every((one) => areObjects(one, 'name', 'class', 'confidence'));
  },
  parts: (data) => (isObject(data[0]) ? new Map([['1', data]]) : numbered(data)),
  read(results) {
    if (results.some((entry) => !('box' in entry))) {
      throw new SceneError('The results of a classifier list no objects: use a detection model.');
    }
    const along = (box, axis) => Object.keys(isObject(box) ? box : fail()).filter((name) => name[0] === axis).map((name) => box[name]);
    return {
      detections: results.map(({ name, class: kind, confidence, box, track_id: track }) =>
        detection(name || kind, confidence, tracked(name, track), boxBetween(along(box, 'x'), along(box, 'y')))),
    };
  },
};

const numbered = (list) => new Map(list.map((one, index) => [String(index + 1), one]));

const listed = (data) => (Array.isArray(data) ? data : [data]);

function isRoboflowAnswer(data) {
  const found = isObject(data?.predictions) ? data.predictions.predictions : data?.predictions;
  return areObjects(found, 'x', 'width', 'class') || (Array.isArray(found) && !found.length && 'image' in data);
}

const ROBOFLOW = {
  name: 'Roboflow',
  matches: (data) => listed(data).length > 0 && listed(data).every(isRoboflowAnswer),
  parts: (data) => numbered(listed(data).map(({ predictions }) => predictions.predictions ?? predictions)),
  read: (predictions) => ({
    detections: predictions.map(({ class: label, confidence = 1, tracker_id: track, x, y, width, height }) =>
      detection(label, confidence, tracked(label, track), imageBox(x, y, width, height))),
  }),
};

/** Lines of a YOLO file: class, box, confidence; or class and points of an outline. */
export class Lines extends Array {}

const YOLO = {
  name: 'YOLO',
  matches: (data) => data instanceof Lines,
  read: (lines) => ({
    detections: Array.from(lines, ([label, ...rest]) => {
      const values = rest.map(Number);
      const score = values.length % 2 ? values.pop() : 1;
      if (values.length === 4) return detection(label, score, '', imageBox(...values));
      return detection(label, score, '', boxBetween(...[0, 1].map((axis) => values.filter((_, index) => index % 2 === axis))));
    }),
  }),
};

// ------------------------------------------------------------------------------ Label Studio

/** The first list of labels of a region, such as `rectanglelabels`. */
const labelsOf = (value) =>
  Object.entries(value).find(([name, labels]) => name.endsWith('labels') && Array.isArray(labels) && labels.length)?.[1] ?? [];

/** The results of a task in the short export, JSON-MIN. */
const shortResults = (task) => Object.values(task).filter(Array.isArray).flat();

function percentBox({ original_width: width = 100, original_height: height = 100 }, value) {
  const [across, down] = [must(width) / 100, must(height) / 100];
  if (value.points) return boxBetween(value.points.map(([x]) => must(x) * across), value.points.map(([, y]) => must(y) * down));
  if (!('width' in value) && !('radiusX' in value)) return {}; // brush strokes or a key point
  const [x, y, theta] = [must(value.x) * across, must(value.y) * down, radians(value.rotation ?? 0)];
  if ('radiusX' in value) return imageBox(x, y, 2 * must(value.radiusX) * across, 2 * must(value.radiusY) * down, theta);
  const [wide, high] = [must(value.width) * across, must(value.height) * down];
  // The rotation is about the upper left corner.
  const [cos, sin] = [Math.cos(theta) / 2, Math.sin(theta) / 2];
  return imageBox(x + cos * wide - sin * high, y + sin * wide + cos * high, wide, high, theta);
}

function isTask(data) {
  if (!isObject(data)) return false;
  const isWhole = 'data' in data && ('annotations' in data || 'predictions' in data);
  const isAnnotation = hasList(data, 'result') && 'task' in data;
  return isWhole || isAnnotation || shortResults(data).some((one) => isObject(one) && labelsOf(one).length > 0);
}

const LABEL_STUDIO = {
  name: 'Label Studio',
  matches: (data) => listed(data).length > 0 && listed(data).every(isTask),
  parts: (data) => new Map(listed(data).map((task, index) => [String(task.id ?? index + 1), task])),
  read(task) {
    const choices = [...(task.annotations ?? []).filter((one) => one.was_cancelled !== true), ...(task.predictions ?? [])];
    const results = task.result ?? choices[0]?.result ?? shortResults(task);
    return {
      detections: results.map((result) => [result, result.value ?? result]).filter(([, value]) => labelsOf(value).length)
        .map(([result, value]) => detection(labelsOf(value)[0], result.score ?? 1, '', percentBox(result, value))),
    };
  },
};

// -------------------------------------------------------------------------------------- CVAT

const SHAPES = ['box', 'polygon', 'polyline', 'ellipse', 'mask', 'cuboid'];

function shapeBox(shape) {
  const value = (name) => {
    const found = shape.attributes.get(name)?.trim();
    return must(found ? Number(found) : null);
  };
  const theta = radians(shape.attributes.has('rotation') ? value('rotation') : 0);
  if (shape.tag === 'box' || shape.tag === 'cuboid') {
    const names = [...shape.attributes.keys()].filter((name) => /^[xy][tb][lr]/.test(name));
    return boxBetween(...['x', 'y'].map((axis) => names.filter((name) => name[0] === axis).map(value)), theta);
  }
  if (shape.tag === 'mask') {
    const [left, top, width, height] = ['left', 'top', 'width', 'height'].map(value);
    return imageBox(left + width / 2, top + height / 2, width, height);
  }
  if (shape.tag === 'ellipse') return imageBox(value('cx'), value('cy'), 2 * value('rx'), 2 * value('ry'), theta);
  const points = shape.attributes.get('points').split(';').map((point) => point.split(',').map(Number));
  return boxBetween(points.map(([x]) => x), points.map(([, y]) => y));
}

const CVAT = {
  name: 'CVAT',
  matches: (data) => data instanceof XmlElement,
  parts(data) {
    const parts = new Map();
    for (const image of data.all('image')) {
      parts.set(image.attributes.get('id') ?? '', image.children.map((shape) => ({ name: '', owner: image, shape })));
    }
    for (const track of data.all('track')) {
      const name = `${track.attributes.get('label')}_${track.attributes.get('id')}`;
      for (const shape of track.children) {
        const frame = shape.attributes.get('frame');
        if (frame !== undefined && shape.attributes.get('outside') !== '1') collect(parts, frame, { name, owner: track, shape });
      }
    }
    return parts;
  },
  read(entries) {
    const shapes = entries.filter(({ shape }) => SHAPES.includes(shape.tag));
    return {
      detections: shapes.map(({ name, owner, shape }) =>
        detection(shape.attributes.get('label') || owner.attributes.get('label'), 1, name, shapeBox(shape))),
      notes: excluded(entries.length - shapes.length, 'tags, points and skeletons'),
    };
  },
};

export const IMAGE_FORMATS = [CVAT, YOLO, COCO, LABEL_STUDIO, ROBOFLOW, ULTRALYTICS];
