/**
 * Reads the texts that the command `scene` reads: requests, training scenes, messages of ROS, and
 * files of detectors, annotation tools and simulators. The Python modules `scene_client.files` and
 * `scene_client.formats` do the same; tests hold the two together.
 */

import { fromMessage, isObject, REMEDY, unwrapped } from './detections.js';
import { IMAGE_FORMATS, Lines } from './image_formats.js';
import { leftPairs } from './image_plane.js';
import { SceneError } from './scene.js';
import { LABEL_COLUMNS, Table, WORLD_FORMATS } from './world_formats.js';
import { parseXml } from './xml.js';

const FORMATS = [...WORLD_FORMATS, ...IMAGE_FORMATS];

/** Maximum size of a file in bytes. */
export const MOST_BYTES = 64 * 2 ** 20;

/**
 * Finds the scenes in a text.
 * @returns {{names: string[], read: (index: number, labels?: Map | null) => {scene: object, notes?: Array}}}
 *   names of the scenes (lines, images, frames or rooms), and a function that reads one of them. A
 *   request has no notes
 * @throws {SceneError}
 */
export function scenesIn(source) {
  const text = source.replace(/^\uFEFF/, '');
  const lines = jsonLines(text);
  if (!lines) return scenesOf(parsed(text));
  return {
    names: lines.map(([number]) => String(number)),
    read: (index, labels) => single(scenesOf(parsed(lines[index][1])), labels),
  };
}

function single({ names, read }, labels) {
  if (names.length !== 1) throw new SceneError(`The line has ${names.length} scenes: use a file with one of them.`);
  return read(0, labels);
}

/** The numbered lines of a text with one JSON value a line; null for other texts. */
function jsonLines(text) {
  const lines = text.split('\n').map((line, index) => [index + 1, line]).filter(([, line]) => line.trim());
  if (lines.length < 2 || !/^[{[].*[}\]]\s*$/s.test(lines[0][1].trimStart())) return null;
  try {
    json(lines[0][1]);
  } catch {
    return null;
  }
  return lines;
}

// Texts, the numbers that JSON lacks, and whole numbers that JavaScript would round, such as ids of Hydra.
const SPECIAL = /"(?:[^"\\]|\\.)*"|-?\b(?:NaN|Infinity)\b|(?<![\w.+-])\d{16,}(?![\w.])/g;

function json(text) {
  try {
    return JSON.parse(text.replace(SPECIAL, (part) => (part[0] === '"' ? part : /\d/.test(part) ? `"${part}"` : 'null')));
  } catch (error) {
    throw new SceneError(`This is neither JSON nor a list of labels, and no other known format: ${error.message.replace(/\s+/g, ' ')}.`);
  }
}

function parsed(text) {
  const start = text.trimStart()[0] ?? '';
  if (start === '<') return xml(text);
  if (!'{['.includes(start)) {
    const lines = text.split(/\r?\n/).filter((line) => line.trim());
    const table = lines.length && tableOf(lines);
    if (table) return table;
    const words = lines.map((line) => line.trim().split(/\s+/));
    if (words.length && words.every((line) => line.length >= 5 && line.every(isNumber))) return Lines.from(words);
    if (/^(---\s|[\w.-]+:(\s|$))/.test(text)) {
      throw new SceneError('This is YAML, as “ros2 topic echo” prints it. Convert it to JSON first, for example with Python’s yaml and json.');
    }
    const labels = lines.flatMap((line) => line.split(',')).map((label) => label.trim()).filter(Boolean);
    if (labels.length && !/[{}[\]":<]/.test(text) && !labels.some(isNumber)) return labels;
  }
  return json(text);
}

const isNumber = (word) => word !== '' && (Number.isFinite(Number(word)) || /^[+-]?(nan|inf(inity)?)$/i.test(word));

/** The rows of a CSV file, or null if the first line does not name the columns. */
function tableOf([first, ...lines]) {
  const header = first.toLowerCase();
  const delimiter = [',', ';', '\t'].reduce((best, one) => (header.split(one).length > header.split(best).length ? one : best));
  const names = header.split(delimiter).map((name) => name.trim().replace(/^"|"$/g, ''));
  if (names.length < 2 || !LABEL_COLUMNS.some((name) => names.includes(name))) return null;
  if (new Set(names).size < names.length) throw new SceneError('The table has two columns of the same name.');
  return Table.from(lines, (line) => Object.fromEntries(cellsOf(line, delimiter).slice(0, names.length).map((cell, index) => [names[index], cell])));
}

function cellsOf(line, delimiter) {
  const cells = [];
  const cell = new RegExp(`(?:"((?:[^"]|"")*)"|([^"${delimiter}][^${delimiter}]*|))(?:${delimiter}|$)`, 'y');
  while (cell.lastIndex <= line.length) {
    const at = cell.lastIndex;
    const found = cell.exec(line);
    if (!found) throw new SceneError('The table has a quotation mark without its partner.');
    cells.push((found[1]?.replaceAll('""', '"') ?? found[2]).trim());
    if (at + found[0].length >= line.length && !found[0].endsWith(delimiter)) break;
  }
  return cells;
}

function xml(text) {
  if (/<!DOCTYPE|<!ENTITY/.test(text)) throw new SceneError('This is XML with a document type, which the page does not read.');
  const root = xmlRoot(text);
  if (root.tag !== 'annotations') throw new SceneError(`This is XML with the root <${root.tag.slice(0, 40)}>. Only exports of CVAT are read.`);
  return root;
}

function xmlRoot(text) {
  try {
    return parseXml(text.trimStart());
  } catch (error) {
    if (!(error instanceof SyntaxError)) throw error;
    throw new SceneError(`This is not XML that can be read: ${error.message}.`);
  }
}

// ------------------------------------------------------------------------------------ formats

/** The scenes in parsed data. */
function scenesOf(given) {
  const data = unwrapped(given);
  const one = (read) => ({ names: [''], read: (_, labels = null) => read(labels) });
  if (isObject(data) && data.detections != null) return one((labels) => fromMessage(data, labels));
  const format = FORMATS.find(({ matches }) => matches(data));
  if (!format) return one((labels) => ({ scene: withLabels(request(data), labels) }));
  const parts = guarded(format.name, () => (format.parts ? format.parts(data) : new Map([['', data]])));
  if (!parts.size) throw new SceneError('The file contains no objects.');
  return {
    names: [...parts.keys()],
    read: (index, labels = null) => fromMessage(guarded(format.name, () => format.read([...parts.values()][index])), labels),
  };
}

function guarded(name, read) {
  try {
    return read();
  } catch (error) {
    if (!(error instanceof TypeError || error instanceof RangeError)) throw error;
    throw new SceneError(`The file looks like ${name}, but a field is missing or has a wrong type.`);
  }
}

// ----------------------------------------------------------------------------------- requests

/** Fields of the training format that a request does not have. */
const TRAINING = ['scene_id', 'source', 'group', 'viewer_frame', 'counts', 'false_relations', 'confirmed'];
const TRAINING_OBJECT = ['box2d', 'count'];

/** A request, a list of objects or a training scene as a request. */
function request(data) {
  if (Array.isArray(data) && data.every((thing) => typeof thing === 'string' || (isObject(thing) && 'label' in thing))) return { objects: data };
  if (!isObject(data) || !Array.isArray(data.objects)) {
    throw new SceneError(`${kindOf(data)} is neither a scene with a list of objects nor a known format.`);
  }
  const isNumbered = (thing) => isObject(thing) && (Number.isSafeInteger(thing.id) || TRAINING_OBJECT.some((name) => name in thing));
  if (!TRAINING.some((name) => name in data) && !data.objects.some(isNumbered)) return data;
  try {
    return ofTraining(data);
  } catch (error) {
    if (!(error instanceof TypeError)) throw error;
    throw new SceneError('This is not a scene of the training format.');
  }
}

function kindOf(data) {
  if (!isObject(data)) return Array.isArray(data) ? 'A JSON list' : 'A JSON value';
  const names = Object.keys(data).slice(0, 5).map((name) => name.slice(0, 40));
  return names.length ? `A JSON object with the fields ${names.join(', ')}` : 'An empty JSON object';
}

const without = (fields, ...names) =>
  Object.fromEntries(Object.entries(fields).filter(([name, value]) => value != null && !names.includes(name)));

/** The id of an object with a number is its label, followed by the number if several objects have the label. */
function ofTraining(scene) {
  const things = scene.objects.filter(isObject);
  const counts = new Map();
  for (const { label } of things) {
    if (typeof label !== 'string') throw new TypeError('an object has no label');
    counts.set(label, (counts.get(label) ?? 0) + 1);
  }
  const numbered = things.filter(({ id }) => Number.isSafeInteger(id));
  const names = new Map(numbered.map(({ id, label }) => [id, counts.get(label) > 1 ? `${label}_${id}` : label]));
  if (new Set(names.values()).size < numbered.length) throw new TypeError('two objects have the same id');
  const named = (id) => names.get(id) ?? id;
  const objects = scene.objects.map((thing) => {
    if (!isObject(thing)) return thing;
    const ends = ['id', 'supported_by'].filter((end) => thing[end] != null).map((end) => [end, named(thing[end])]);
    return { ...without(thing, ...TRAINING_OBJECT), ...Object.fromEntries(ends) };
  });
  const hasPoses = things.length === objects.length && things.every((thing) => 'position' in thing);
  const stated = scene.relations?.length && !hasPoses ? scene.relations.map((one) => relationOf(one, named)) : imageRelations(scene.objects, objects);
  const isFixed = !scene.viewer_frame && ('scene_id' in scene || 'viewer_frame' in scene) && scene.frame_id == null;
  return {
    ...without(scene, ...TRAINING, 'relations'), objects,
    ...(stated.length && { relations: stated }), ...(isFixed && { frame_id: 'map' }),
  };
}

function relationOf(given, named) {
  const [subject, relation, object] = isObject(given) ? [given.subject, given.relation, given.object] : [...given];
  return [named(subject), relation, named(object)];
}

/** The relations left between boxes in an image, if all objects have ids and boxes. */
function imageRelations(annotated, objects) {
  const boxes = annotated.map((thing) => thing?.box2d ?? null);
  if (boxes.includes(null) || objects.some((thing) => 'position' in thing || !('id' in thing))) return [];
  const pairs = leftPairs(boxes, [...boxes.keys()]).sort(([a, b], [c, d]) => a - c || b - d);
  return pairs.map(([first, second]) => [objects[first].id, 'left', objects[second].id]);
}

/** Replaces the labels of objects that are class ids. */
function withLabels(scene, labels) {
  const named = (label) => {
    if (!/^\p{Nd}+$/u.test(String(label))) return label;
    const found = labels?.get(String(label));
    if (!found) throw new SceneError(`An object has a class id instead of a label. ${REMEDY}`);
    return found;
  };
  return { ...scene, objects: scene.objects.map((thing) => (isObject(thing) ? { ...thing, label: named(thing.label) } : named(thing))) };
}
