/** The probable places of missing objects, seen from above. */

import { halves, overlap, round, UNKNOWN_SIZE } from './geometry.js';
import { sizesOf } from './questions.js';
import { freshId, FULL, MOST_OBJECTS, sizer } from './scene.js';

/** Direction from the anchor to the subject of a relation, in the robot's axes: [ahead, left]. */
const DIRECTION = { left: [0, 1], right: [0, -1], front: [-1, 0], behind: [1, 0] };
const ABOVE = ['on-top', 'above'];
const VERTICAL = [...ABOVE, 'under', 'below'];
/** Distances in metres by the service's rules: minimum gap of "above", maximum gap of neighbours (nearly). */
const CLEAR = 0.1;
const NEIGHBOURS = 0.9;
const THIN = 0.03;
const PARTS = [-1, -0.75, -0.5, -0.25, 0, 0.25, 0.5, 0.75, 1]; // candidate positions, as shares of the free extent
/** Standard deviations that contain 80 % of the objects in the plane, according to the API. */
const FOUR_OF_FIVE = 1.8;
const GAP = 0.15; // metres between neighbours without a learnt offset

/**
 * @typedef {object} Ghost
 * @property {string} label
 * @property {number} probability
 * @property {{relation: string, object: string, probability: number}} placement
 * @property {number} x
 * @property {number} y
 * @property {number} z of its bottom
 * @property {import('./store.js').Extents} size
 * @property {{x: number, y: number, rx: number, ry: number} | null} spread ellipse of the learnt offset
 */

let last = { keys: [], ghosts: [] };

/** The shown suggestions, each at its most probable free place. @returns {Ghost[]} */
export function ghostsOf(state) {
  const answer = state.answers[state.shown].missing?.answer;
  const model = state.models[state.shown];
  const keys = [answer, state.things, state.viewer, state.tab, state.words, state.draft, model, state.at];
  if (last.keys.every((key, index) => key === keys[index]) && last.keys.length) return last.ghosts;
  const shown = answer && state.tab === 'missing' && !state.draft;
  last = { keys, ghosts: shown ? suggest(state, answer, sizesOf(state, state.models[0])) : [] };
  return last.ghosts;
}

function suggest(state, answer, sizes) {
  const boxes = state.things.map(sizer(sizes));
  const ghosts = [];
  for (const { label, probability, placements } of answer.missing) {
    const size = sizes.get(label) ?? UNKNOWN_SIZE;
    const asked = placements.find(
      (one) => state.at?.relation === one.relation && state.at?.object === one.object,
    );
    const anchorOf = (one) => boxes.find((box) => box.id === one?.object);
    const likeliest = placements.find((one) => hasRoom(anchorOf(one), one.relation, size));
    const wanted = asked ?? (state.at ? { ...state.at, probability: null } : likeliest);
    const anchor = anchorOf(wanted);
    if (anchor && !state.things.some((thing) => thing.label === label)) {
      const place = stand(anchor, wanted, size, state.viewer, boxes, ghosts);
      ghosts.push({ id: label, label, probability, placement: wanted, size, yaw: 0, ...place });
    }
  }
  return ghosts;
}

/** Whether a place exists: "under" and "below" need free height below the anchor. */
const hasRoom = (anchor, relation, size) =>
  anchor && (!['under', 'below'].includes(relation) || anchor.z >= size.z);

/** Rotates a vector (ahead, left) of the viewer to the axes of the board; `within` is the inverse. */
function turned(viewer, ahead, left) {
  const [c, s] = [Math.cos(viewer.yaw), Math.sin(viewer.yaw)];
  return [ahead * c - left * s, ahead * s + left * c];
}
const within = ({ yaw }, x, y) => turned({ yaw: -yaw }, x, y);

/**
 * The place of a suggestion, by the rules with which the service derives relations from positions.
 * Candidates near the learnt offset come first. The first choice is a place without objects and other
 * suggestions, the second a place without collisions.
 */
function stand(anchor, placement, size, viewer, boxes, ghosts) {
  const { relation, offset } = placement;
  const others = [...boxes.filter((box) => box !== anchor), ...ghosts];
  const learnt = offset && { x: anchor.x + offset.mean.x, y: anchor.y + offset.mean.y };
  const spread = learnt && { ...learnt, rx: FOUR_OF_FIVE * offset.std.x, ry: FOUR_OF_FIVE * offset.std.y };
  const centre = offset && anchor.z + anchor.size.z / 2 + offset.mean.z;
  const bottom = offset ? Math.max(0, centre - size.z / 2) : null;
  const z = round(height(anchor, relation, size, bottom));
  const find = VERTICAL.includes(relation) ? over : beside;
  const places = [...find(anchor, relation, size, viewer, learnt)].map(([x, y]) => ({ x: round(x), y: round(y), z }));
  const free = (place) => !others.some((other) => meet({ ...place, size, yaw: 0 }, other));
  const apart = (place) => !ghosts.some((ghost) => overlap({ ...place, size, yaw: 0 }, ghost));
  const place = places.find((one) => free(one) && apart(one)) ?? places.find(free) ?? places[0];
  return { ...place, spread };
}

/** Whether two boxes intersect. Boxes that only touch, or are as thin as a rug, do not. */
function meet(a, b) {
  return overlap(a, b) && a.z + a.size.z > b.z + THIN && b.z + b.size.z > a.z + THIN;
}

/** The height of the bottom of a suggestion; at least 0, the floor. */
function height(anchor, relation, size, learnt) {
  const top = anchor.z + anchor.size.z;
  const heights = {
    'on-top': () => top,
    above: () => Math.max(top + CLEAR, learnt ?? top + 0.3),
    under: () => Math.max(0, anchor.z - size.z),
    below: () => Math.max(0, Math.min(learnt ?? 0, anchor.z - CLEAR - size.z)),
  };
  return heights[relation]?.() ?? learnt ?? 0;
}

/** Places on, above or below the anchor, with overlapping footprints; nearest to the learnt offset first. */
function* over(anchor, relation, size, viewer, learnt) {
  const half = halves({ size, yaw: -anchor.yaw });
  const room = (axis) => anchor.size[axis] / 2 - half[axis];
  // An object below may be larger: its footprint then contains that of the anchor.
  const limit = (axis) => (ABOVE.includes(relation) ? Math.max(0, room(axis)) : Math.abs(room(axis)));
  const along = { yaw: (anchor.yaw * Math.PI) / 180 };
  const [x, y] = learnt ? within(along, learnt.x - anchor.x, learnt.y - anchor.y) : [0, 0];
  const begin = [clamp(x, limit('x')), clamp(y, limit('y'))];
  const all = [begin];
  for (const p of PARTS) for (const q of PARTS) all.push([p * limit('x'), q * limit('y')]);
  for (const [p, q] of nearest(all, begin)) {
    const [dx, dy] = turned(along, p, q);
    yield [anchor.x + dx, anchor.y + dy];
  }
}

/** Places along the axis of a horizontal relation, with separate footprints and the larger offset on this axis. */
function* beside(anchor, relation, size, viewer, learnt) {
  const [ahead, left] = DIRECTION[relation];
  const [axis, other] = ahead ? ['x', 'y'] : ['y', 'x'];
  const turn = (viewer.yaw * 180) / Math.PI;
  const [half, own] = [halves({ size, yaw: -turn }), halves({ size: anchor.size, yaw: anchor.yaw - turn })];
  const touching = half[axis] + own[axis];
  const flush = half[other] + own[other];
  const [p, q] = learnt ? within(viewer, learnt.x - anchor.x, learnt.y - anchor.y) : [0, 0];
  const out = p * ahead + q * left;
  const aside = clamp(ahead ? q : p, flush);
  const least = Math.max(touching + (learnt ? THIN : GAP), CLEAR + THIN);
  const furthest = Math.max(least, touching + NEIGHBOURS);
  const begin = [Math.min(Math.max(out, least), furthest), aside];
  const all = [begin];
  for (let more = 0; more <= furthest - least; more += 0.25) {
    for (let by = -1.5; by <= 1.5; by += 0.25) all.push([least + more, aside + by]);
  }
  const told = all.map(([far, by]) => [far, clamp(by, far - THIN)])
    .filter(([far, by]) => Math.hypot(far - touching, Math.max(0, Math.abs(by) - flush)) <= furthest - touching);
  for (const [far, by] of nearest(told, begin)) {
    const [dx, dy] = ahead ? turned(viewer, ahead * far, by) : turned(viewer, by, left * far);
    yield [anchor.x + dx, anchor.y + dy];
  }
}

const clamp = (value, limit) => Math.min(limit, Math.max(-limit, value));
const nearest = (places, [x, y]) =>
  places.map((place) => [Math.hypot(place[0] - x, place[1] - y), place]).sort((a, b) => a[0] - b[0]).map(([, place]) => place);

/** Puts a suggestion on the board. @returns {string | null} its id; null if the scene is full */
export function accept(store, ghost) {
  const { things } = store.get();
  if (things.length >= MOST_OBJECTS) {
    store.set({ complaint: FULL });
    return null;
  }
  const id = freshId(things, ghost.label);
  const { label, x, y, z } = ghost;
  store.edit({
    things: [...things, { id, label, x, y, z, size: null, yaw: 0, confidence: 1 }],
    selected: id,
    at: null,
  });
  return id;
}
