/** Labels of the numeric class ids of detectors. */

import { SceneError } from './scene.js';

const COCO = (
  'person,bicycle,car,motorcycle,airplane,bus,train,truck,boat,traffic light,fire hydrant,stop sign,parking meter,bench,bird,cat,' +
  'dog,horse,sheep,cow,elephant,bear,zebra,giraffe,backpack,umbrella,handbag,tie,suitcase,frisbee,skis,snowboard,sports ball,kite,' +
  'baseball bat,baseball glove,skateboard,surfboard,tennis racket,bottle,wine glass,cup,fork,knife,spoon,bowl,banana,apple,' +
  'sandwich,orange,broccoli,carrot,hot dog,pizza,donut,cake,chair,couch,potted plant,bed,dining table,toilet,tv,laptop,mouse,' +
  'remote,keyboard,cell phone,microwave,oven,toaster,sink,refrigerator,book,clock,vase,scissors,teddy bear,hair drier,toothbrush'
).split(',');
const UNUSED = [12, 26, 29, 30, 45, 66, 68, 69, 71, 83];
const USED = Array.from({ length: 90 }, (_, index) => index + 1).filter((id) => !UNUSED.includes(id));

const WELL_KNOWN = {
  coco80: () => new Map(COCO.map((label, index) => [String(index), label])),
  coco91: () => new Map(COCO.map((label, index) => [String(USED[index]), label])),
};

/**
 * @param {'' | 'coco80' | 'coco91' | 'own'} choice
 * @param {string} names the user's own labels: JSON, the YAML of a YOLO data set, or one label a line
 * @returns {import('./detections.js').Labels | null} null without a choice
 * @throws {SceneError}
 */
export function labelsOf(choice, names) {
  if (!choice) return null;
  return WELL_KNOWN[choice]?.() ?? ownLabels(names);
}

function ownLabels(names) {
  const entries = parsed(names.trim()).map(([id, label]) => [String(id).trim(), label]);
  if (!entries.length || !entries.every(([, label]) => label === null || (typeof label === 'string' && label))) {
    throw new SceneError('The names of the class ids must be labels, one a line from id 0, or JSON.');
  }
  return new Map(entries);
}

function parsed(text) {
  let found;
  try {
    found = JSON.parse(text);
  } catch {
    const block = /^names:([^]*)/m.exec(text)?.[1];
    if (block === undefined) return [...text.split(/\r?\n/).entries()];
    const inline = /^[ \t]*\[([^\]]*)\]/.exec(block);
    const lines = [...block.matchAll(/^[ \t]*(?:-|(\d+):)[ \t]*(.+?)[ \t]*$/gm)].map(([, id, name]) => [id, name]);
    const entries = inline ? inline[1].split(',').map((name) => [undefined, name.trim()]) : lines;
    return entries.map(([id, name], index) => [id ?? index, name.replace(/^['"]+|['"]+$/g, '')]);
  }
  const list = found?.categories ?? found;
  if (Array.isArray(list)) return list.map((entry, index) => (entry?.name === undefined ? [index, entry] : [entry.id, entry.name]));
  return Object.entries(list ?? {});
}
