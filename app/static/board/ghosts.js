/** Places on the board for missing objects ("ghosts"). */

import { judgedBy } from './edges.js';
import { fits, fitsInto, gap, halves, inside, overlap, round, UNKNOWN_SIZE } from './geometry.js';
import { LIKELY, sizesOf } from './questions.js';
import { freshId, FULL, MOST_OBJECTS, sizer } from './scene.js';

/** Direction from the anchor to the subject of a relation, in the robot's axes: [ahead, left]. */
const DIRECTION = { left: [0, 1], right: [0, -1], front: [-1, 0], behind: [1, 0] };
const ABOVE = ['on-top', 'above'];
const BENEATH = ['under', 'below'];
const HOLDING = ['inside', 'contains'];
/** Distances in metres by the service's rules: minimum gap of "above", maximum gap of neighbours (nearly). */
const CLEAR = 0.1;
const NEIGHBOURS = 0.9;
const THIN = 0.03;
const OVERHANG = 1.25; // share of the support's extent that a footprint on it may have
/** The part of half a suggestion that stays over the anchor at its learnt offset. */
const HELD = 0.6;
const GAP = 0.15; // metres between neighbours without a learnt offset
const COVER = 0.05; // maximum height in metres of sheets and cloths, on which other suggestions may lie
const EXACT = 0.01; // metres; a ghost this near to its learnt offset stands there
const MARGINS = [0.3, 0.05]; // metres that stay free between two ghosts, preferred first
/** Suggestions may overlap lower and higher boxes, such as floors, rugs and ceilings. */
const FLOOR = 0.1;
const CEILING = 2.2;
/** Side of the square that stays free around the robot, in metres. */
export const ROBOT_SIDE = 0.5;
const PARTS = Array.from({ length: 17 }, (_, index) => index / 8 - 1); // candidate positions, as shares of the free extent

/**
 * @typedef {object} Ghost
 * @property {string} label
 * @property {number} probability
 * @property {{relation: string, object: string, probability: number}} placement
 * @property {number} x
 * @property {number} y
 * @property {number} z of its bottom
 * @property {boolean} shifted whether it stands elsewhere than the offset of the answer says
 * @property {import('./store.js').Extents} size
 */

/** Says that a ghost stands elsewhere than the answer says. */
export const SHIFTED = 'drawn at the nearest free place';

let last = { keys: [], ghosts: [] };

/** The shown suggestions. @returns {Ghost[]} */
export function ghostsOf(state) {
  const own = state.answers[state.shown];
  const model = state.models[state.shown];
  const keys = [own, state.things, state.viewer, state.tab, state.words, state.draft, model, state.at, state.line, state.covered];
  if (last.keys.every((key, index) => key === keys[index]) && last.keys.length) return last.ghosts;
  const sizes = sizesOf(state, state.models[0]);
  const shown = own.missing?.answer && state.tab === 'missing' && !state.draft;
  last = { keys, ghosts: shown ? standing(likely(own, state), state.things.map(sizer(sizes)), state.viewer, sizes, state.at) : [] };
  return last.ghosts;
}

const LEAST = 0.01;

/**
 * The missing objects of at least 1 %, and their likely places beside objects that belong to the scene; all objects and
 * places in an answer about a place.
 * @param {object} own the answers of one model
 */
export function likely(own, state) {
  const { missing } = own.missing.answer;
  if (state.at) return missing;
  const wrong = new Set((judgedBy(own, state)?.outliers ?? []).filter((one) => one.is_outlier).map(({ object }) => object));
  const isLikely = ({ probability, object }) => probability >= LIKELY && !wrong.has(object);
  return missing.filter(({ probability }) => probability >= LEAST)
    .map((one) => ({ ...one, placements: one.placements.filter(isLikely) }));
}

/**
 * Missing objects at the first of their placements with free space, or at the place `at` of the question.
 * A ghost stands at the offset of the answer, else at the free place nearest to it. It overlaps neither the
 * robot nor another ghost (but a sheet) nor a box, except those it stands on, under or in, or contains.
 * Missing objects without a free place have no ghost.
 * @returns {Ghost[]}
 */
export function standing(missing, boxes, viewer, sizes, at = null) {
  const robot = { x: viewer.x, y: viewer.y, z: 0, yaw: 0, size: { x: ROBOT_SIDE, y: ROBOT_SIDE, z: 1 } };
  const ghosts = [];
  for (const { label, probability, placements } of missing) {
    const size = sizes.get(label) ?? UNKNOWN_SIZE;
    const asked = at && placements.filter((one) => one.relation === at.relation && one.object === at.object);
    for (const placement of asked ? [...asked, { ...at, probability: null }].slice(0, 1) : placements) {
      const anchor = boxes.find((box) => box.id === placement.object);
      const place = anchor && freeAt(anchor, placement, size, viewer, [...boxes, robot], ghosts);
      if (place) {
        ghosts.push({ id: label, label, probability, placement, size, yaw: 0, ...place });
        break;
      }
    }
  }
  return ghosts;
}

/** The place nearest to the learnt offset that is free and where the relation to the anchor holds, or undefined. */
function freeAt(anchor, { relation, offset }, size, viewer, boxes, ghosts) {
  const own = { size, yaw: 0 };
  if (!hasRoom(anchor, relation, own)) return undefined;
  const learnt = offset && { x: anchor.x + offset.mean.x, y: anchor.y + offset.mean.y };
  const centre = offset && anchor.z + anchor.size.z / 2 + offset.mean.z;
  const vertical = !DIRECTION[relation];
  const others = boxes.filter((box) => box !== anchor);
  const near = others.filter((box) => overlap(box, anchor));
  const supports = near.filter((box) => box.z + box.size.z <= anchor.z + THIN);
  const carried = near.filter((box) => box.z >= anchor.z + anchor.size.z - THIN);
  const ground = Math.max(0, ...supports.map((box) => box.z + box.size.z));
  const z = height(anchor, relation, size, offset ? Math.max(0, centre - size.z / 2) : null, ground);
  // An object on the anchor is also above its supports, and one below the anchor is also below its load.
  const passed = [
    ...(ABOVE.includes(relation) || HOLDING.includes(relation) ? supports : []),
    ...(BENEATH.includes(relation) || HOLDING.includes(relation) ? carried : []),
  ];
  const obstacles = [...others.filter((box) => !passed.includes(box)), ...(vertical ? [] : [anchor])]
    .filter((box) => box.z + box.size.z > FLOOR && box.z < CEILING);
  const places = (vertical ? over(anchor, relation, size, learnt) : beside(anchor, relation, size, viewer, learnt))
    .map(([x, y]) => ({ x: round(x), y: round(y), ...own }));
  // An object beside the anchor may stand on the anchor's support.
  const supportOf = (place) => (vertical ? undefined : supports.find((box) => inside(place, box)));
  const free = places.filter((place) => {
    const support = supportOf(place);
    return obstacles.every((box) => box === support || !overlap(place, box));
  });
  const isLearnt = ({ x, y }) => learnt && Math.hypot(x - learnt.x, y - learnt.y) < EXACT;
  const clear = (margin) => (one) => !ghosts.some((ghost) => ghost.size.z > COVER && overlap(wider(one, margin), ghost));
  const place = free.filter(isLearnt).find(clear(0)) ?? MARGINS.map((margin) => free.find(clear(margin))).find(Boolean);
  if (!place) return undefined;
  const support = supportOf(place);
  const bottom = round(support ? support.z + support.size.z : z);
  return { x: place.x, y: place.y, z: bottom, shifted: Boolean(learnt) && !isLearnt(place) };
}

/** Whether the sizes of the anchor and of a suggestion allow the relation. */
function hasRoom(anchor, relation, own) {
  const beneath = anchor.z + THIN >= own.size.z; // free height below the anchor
  const rooms = {
    'on-top': () => fits(own, anchor, OVERHANG),
    inside: () => fitsInto(own, anchor),
    contains: () => fitsInto(anchor, own),
    // A lower object stands between the legs of the anchor.
    under: () => beneath || (fits(own, anchor, 1) && own.size.z < anchor.size.z),
    below: () => beneath,
  };
  return rooms[relation]?.() ?? true;
}

const wider = (box, by) => ({ ...box, size: { ...box.size, x: box.size.x + 2 * by, y: box.size.y + 2 * by } });

/** Rotates a vector (ahead, left) of the viewer to the axes of the board; `within` is the inverse. */
function turned(viewer, ahead, left) {
  const [c, s] = [Math.cos(viewer.yaw), Math.sin(viewer.yaw)];
  return [ahead * c - left * s, ahead * s + left * c];
}
const within = ({ yaw }, x, y) => turned({ yaw: -yaw }, x, y);

/** The height of the bottom of a suggestion. `ground` is the height of the anchor's support, or 0, the floor. */
function height(anchor, relation, size, learnt, ground) {
  const top = anchor.z + anchor.size.z;
  const heights = {
    'on-top': () => top,
    above: () => Math.max(top + CLEAR, learnt ?? top + 0.3),
    under: () => (anchor.z + THIN >= size.z ? Math.max(0, anchor.z - size.z) : anchor.z),
    below: () => Math.max(0, Math.min(learnt ?? 0, anchor.z - CLEAR - size.z)),
    inside: () => Math.min(Math.max(learnt ?? anchor.z, anchor.z), Math.max(anchor.z, top - Math.max(size.z, CLEAR))),
    contains: () => Math.min(Math.max(learnt ?? ground, ground, top - size.z), anchor.z),
  };
  return heights[relation]?.() ?? learnt ?? 0;
}

/** Places with footprints that overlap the anchor's; nearest to the learnt offset first. */
function over(anchor, relation, size, learnt) {
  const half = halves({ size, yaw: -anchor.yaw });
  const room = (axis) => anchor.size[axis] / 2 - half[axis];
  // An object below may be larger: its footprint then contains that of the anchor, as that of a container does.
  const around = [...BENEATH, 'contains'].includes(relation);
  const limit = (axis) => (around ? Math.abs(room(axis)) : Math.max(0, room(axis)));
  const held = (axis) => (ABOVE.includes(relation) ? Math.max(limit(axis), anchor.size[axis] / 2 - HELD * half[axis]) : limit(axis));
  const along = { yaw: (anchor.yaw * Math.PI) / 180 };
  const [x, y] = learnt ? within(along, learnt.x - anchor.x, learnt.y - anchor.y) : [0, 0];
  const begin = [clamp(x, held('x')), clamp(y, held('y'))];
  const all = [begin];
  for (const p of PARTS) for (const q of PARTS) all.push([p * limit('x'), q * limit('y')]);
  return nearest(all, begin).map(([p, q]) => {
    const [dx, dy] = turned(along, p, q);
    return [anchor.x + dx, anchor.y + dy];
  });
}

/** Places along the axis of a horizontal relation, with separate footprints and the larger offset on this axis. */
function beside(anchor, relation, size, viewer, learnt) {
  const [ahead, left] = DIRECTION[relation];
  const [axis, other] = ahead ? ['x', 'y'] : ['y', 'x'];
  const turn = (viewer.yaw * 180) / Math.PI;
  const [half, own] = [halves({ size, yaw: -turn }), halves({ size: anchor.size, yaw: anchor.yaw - turn })];
  const touching = half[axis] + own[axis];
  const flush = half[other] + own[other];
  const [p, q] = learnt ? within(viewer, learnt.x - anchor.x, learnt.y - anchor.y) : [0, 0];
  const [out, by] = [p * ahead + q * left, ahead ? q : p];
  const aside = clamp(by, flush);
  const least = Math.max(touching + (learnt ? THIN : GAP), CLEAR + THIN);
  const furthest = Math.max(least, touching + NEIGHBOURS);
  const begin = [Math.min(Math.max(out, least), furthest), aside];
  const all = [begin];
  if (learnt && out >= CLEAR) all.push([out, by]);
  for (let more = 0; more <= furthest - least; more += 0.15) {
    for (let step = -1.5; step <= 1.5; step += 0.15) all.push([least + more, aside + step]);
  }
  const wanted = learnt ? [out, by] : begin;
  return nearest(all.map(([far, along]) => [far, clamp(along, far - THIN)]), wanted).map(([far, along]) => {
    const [dx, dy] = ahead ? turned(viewer, ahead * far, along) : turned(viewer, along, left * far);
    return [anchor.x + dx, anchor.y + dy];
  }).filter(([x, y]) => gap({ x, y, size, yaw: 0 }, anchor) <= NEIGHBOURS);
}

const clamp = (value, limit) => Math.min(limit, Math.max(-limit, value));
const nearest = (places, [x, y]) =>
  places.map((place) => [Math.hypot(place[0] - x, place[1] - y), place]).sort((a, b) => a[0] - b[0]).map(([, place]) => place);

/** Puts a suggestion on the board. @returns {string | null} its id; null if the scene is full */
export function accept(store, { label, x, y, z }) {
  const { things } = store.get();
  if (things.length >= MOST_OBJECTS) {
    store.set({ complaint: FULL });
    return null;
  }
  const id = freshId(things, label);
  const thing = { id, label, x, y, z, size: null, yaw: 0, confidence: 1, placed: false };
  store.edit({ things: [...things, thing], selected: id, at: null });
  return id;
}
