/** Requests and recordings. The page reads them itself, so that they stay in the browser. */

import { SceneError } from './scene.js';

const isObject = (value) => value !== null && typeof value === 'object' && !Array.isArray(value);
/** Whether an object of a scene has another format, a box in an image, or a class id as label. */
const isForeign = (thing) => isObject(thing) && (!('label' in thing) || 'box2d' in thing || /^\d+$/.test(thing.label));
const isName = (thing) => typeof thing === 'string' || (isObject(thing) && typeof thing.label === 'string');

/** A request, or a list of objects as a request; null for other data. */
function sceneOf(data) {
  const scene = Array.isArray(data) && data.every(isName) ? { objects: data } : data;
  const isOwn = isObject(scene) && Array.isArray(scene.objects) && !scene.objects.some((one) => isForeign(isObject(one) ? one : { label: one }));
  return isOwn ? scene : null;
}

function parsed(text) {
  try {
    return JSON.parse(text);
  } catch {
    return undefined;
  }
}

/**
 * The scenes of a request or a recording, by line. The service reads all other texts.
 * @returns {{name: string, scene: object}[] | null} null for a text that the service reads
 * @throws {SceneError} the text is broken JSON, which stays in the browser too
 */
export function ownScenes(text) {
  if (!/^\s*[{[]/.test(text)) return null;
  const data = parsed(text);
  if (data !== undefined) return sceneOf(data) && [{ name: '', scene: sceneOf(data) }];
  const lines = text.split('\n').map((line, index) => [String(index + 1), line]).filter(([, line]) => line.trim());
  const first = parsed(lines[0][1]);
  if (first !== undefined) return sceneOf(first) && lines.map(([name, line]) => ({ name, scene: parsed(line) }));
  if (/\b(NaN|Infinity)\b/.test(text)) return null; // numbers of ROS messages that JSON lacks
  throw new SceneError('This is neither JSON nor JSON lines. Strings and names need double quotes.');
}

/** A scene of a recording as a request. Positions of all objects give their relations. */
export const asRequest = (scene) => (
  scene?.scene_id && scene.objects?.every?.((thing) => thing?.position) ? { ...scene, relations: [] } : scene);
