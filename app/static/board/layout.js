/**
 * Places for objects without a position, from the relations between them.
 *
 * One box after the other takes a free spot: in its container, on its support, over another box, else on the floor or on
 * the wall. The spot where most relations to the placed boxes hold comes first. Boxes overlap only with their containers.
 */

import { fitsInto, halves, overlap, radians, round } from './geometry.js';

const ROBOT = { id: '\u0000robot', x: 0, y: 0, z: 0, yaw: 0, size: { x: 0.4, y: 0.4, z: 1 } }; // not a valid object id
const MIDDLE = 4; // metres from the robot to the first box
const AROUND = 0.8; // metres that stay free in front of the robot
const GAPS = [0.1, 0.02, 0]; // metres between boxes, preferred first
const TOUCH = 1e-6; // metres
const OVER = 0.1; // metres between a box and a box above it
const EYES = 1.5; // height in metres of the centre of hanging things
const LARGEST_LOAD = 1.5; // footprint of a load, as a share of that of its support
/** A cover, such as a mattress on a bed: least share of the footprint of its support, and maximum height in metres. */
const COVER = 0.5;
const FLAT = 0.25;
/** The service's rules for relations: share of the smaller footprint, metres. */
const LEAST_OVERLAP = 0.3;
const CONTACT = 0.05;
const NEIGHBOURS = 1;
const LEAST_OFFSET = 0.1;
/** The canonical form of each relation, and whether its ends are exchanged. */
const CANONICAL = {
  left: ['left', false], right: ['left', true], front: ['front', false], behind: ['front', true],
  'on-top': ['on-top', false], under: ['on-top', true], above: ['above', false], below: ['above', true],
  inside: ['inside', false], contains: ['inside', true],
};

/** Numbers from -1 to 1, at equal distances. */
const evenly = (count) => Array.from({ length: count }, (_, index) => (2 * index) / (count - 1) - 1);
const ON_FACE = evenly(25);
const ON_FLOOR = evenly(61);

const top = (box) => box.z + box.size.z;
const area = (box) => box.size.x * box.size.y;

/**
 * Places `free` boxes among `fixed` boxes.
 * @param {object[]} fixed
 * @param {object[]} free boxes; their own positions do not count
 * @param {{subject: string, relation: string, object: string}[]} relations by id
 * @param {{x: number, y: number, yaw: number}} viewer metres and radians
 * @param {Set<string>} hanging labels of things that hang on a wall or from the ceiling
 * @returns {object[]} the free ones, placed
 */
export function layOut(fixed, free, relations, viewer, hanging) {
  const [c, s] = [Math.cos(viewer.yaw), Math.sin(viewer.yaw)];
  const seen = (box) => {
    const [x, y, yaw] = [box.x - viewer.x, box.y - viewer.y, box.yaw - (viewer.yaw * 180) / Math.PI];
    const { id, z, size } = box;
    return { id, size, x: x * c + y * s, y: y * c - x * s, z, yaw, half: halves({ size, yaw }), hangs: hanging.has(box.label) };
  };
  const places = place(fixed.map(seen), free.map(seen), canonical(relations));
  // Without fixed boxes, the layout begins in front of the robot.
  const shift = fixed.length ? 0 : Math.max(0, Math.min(...[...places.values()].map(({ x, half }) => x - half.x)) - AROUND);
  return free.map((box) => {
    const { x: ahead, y, z } = places.get(box.id);
    const x = ahead - shift;
    return { ...box, x: round(viewer.x + x * c - y * s), y: round(viewer.y + x * s + y * c), z: round(z) };
  });
}

function canonical(relations) {
  return relations.map(({ subject, relation, object }) => {
    const [name, swapped] = CANONICAL[relation];
    return swapped ? [object, name, subject] : [subject, name, object];
  });
}

/** Places boxes in the axes of the viewer. @returns {Map<string, object>} all boxes by id */
function place(fixed, free, triples) {
  const boxes = new Map([...fixed, ...free].map((box) => [box.id, box]));
  const related = new Map([...boxes.keys()].map((id) => [id, []]));
  for (const triple of triples) {
    const [subject, , object] = triple;
    if (subject === object || !boxes.has(subject) || !boxes.has(object)) continue;
    related.get(subject).push(triple);
    related.get(object).push(triple);
  }
  const holders = (box) => related.get(box.id).filter(([id, name, other]) => id === box.id && CAN_HOLD[name]?.(boxes.get(other), box));
  const waiting = new Map(free.map((box) => [box.id, { ...box, holders: holders(box).map(([, name, id]) => [name, id]) }]));
  const placed = new Map(fixed.map((box) => [box.id, box]));
  const side = 3 + 2 * Math.sqrt([...boxes.values()].reduce((sum, box) => sum + area(box), 0)); // of the floor, in metres
  while (waiting.size) {
    const box = nextOf([...waiting.values()], related, placed);
    waiting.delete(box.id);
    placed.set(box.id, bestSpot(box, related.get(box.id), placed, side));
  }
  return placed;
}

/** Whether a box can hold another box by a relation: the sizes allow it. */
const CAN_HOLD = {
  'on-top': (support, box) => area(box) <= LARGEST_LOAD * area(support),
  above: () => true,
  inside: (container, box) => fitsInto(box, container),
};

/**
 * The next box: one whose holders have places, if possible. Standing boxes come first, those with most relations to placed
 * boxes, and hanging ones last. Large boxes come before small ones, such as a mattress before a pillow.
 */
function nextOf(boxes, related, placed) {
  const ranked = boxes.map((box) => {
    const isHeld = box.holders.length > 0;
    const pending = box.holders.filter(([, id]) => !placed.has(id)).length;
    const links = isHeld ? 0 : related.get(box.id).filter(([a, , b]) => placed.has(a) || placed.has(b)).length;
    return { box, pending, links, stage: isHeld ? 1 : 2 * Number(box.hangs) };
  });
  const order = (a, b) => a.pending - b.pending || a.stage - b.stage || b.links - a.links || area(b.box) - area(a.box);
  return ranked.reduce((best, one) => (order(one, best) < 0 ? one : best)).box;
}

/**
 * @typedef {object} Spot
 * @property {number} x
 * @property {number} y
 * @property {number} z of the bottom of the box
 * @property {number} far metres from the preferred place
 * @property {string[]} within ids of the containers that the box is in
 * @property {object} [on] the box below
 * @property {number} holding relations to placed boxes that hold
 */

/** A box at its best free spot. The first search with a free spot counts. */
function bestSpot(box, triples, placed, side) {
  const boxes = [...placed.values()];
  const of = (relation) => box.holders.filter(([name, id]) => name === relation && placed.has(id)).map(([, id]) => placed.get(id));
  const supports = of('on-top').map((support) => carrier(support, box, boxes));
  const known = triples.map(([subject, name, object]) => [name, placed.get(subject), placed.get(object)]).filter(([, a, b]) => a || b);
  // A box that does not fit on its support, or that lies under furniture, stands near it.
  const [, a, b] = known.find(([name]) => CAN_HOLD[name]) ?? [];
  const near = a ?? b ?? { x: MIDDLE, y: 0 };
  const searches = [
    () => of('inside').flatMap((container) => inside(box, container, boxes)),
    () => supports.flatMap((support) => onTop(box, support, false)),
    () => supports.flatMap((support) => onTop(box, support, true)),
    () => of('above').flatMap((lower) => over(box, lower, true, [], () => Math.max(top(lower) + OVER, hanging(box)))),
    () => (box.hangs ? onWall(box, boxes, near) : onFloor(box, side, near)),
    () => [spotAt(near, Math.max(AROUND, ...boxes.map(({ x, half }) => x + half.x)) + GAPS[0] + box.half.x, 0, 0)],
  ];
  const here = { ...box };
  for (const search of searches) {
    const spots = search();
    if (known.length) for (const spot of spots) spot.holding = holding(known, Object.assign(here, spot));
    for (const gap of GAPS) {
      const isFree = freedom(box, boxes, gap);
      const found = spots.reduce((best, spot) => ((!best || isBetter(spot, best)) && isFree(spot) ? spot : best), null);
      if (found) return { ...box, ...found };
    }
  }
  return null;
}

/** Number of the relations that hold; one end of each is the box, and undefined. */
const holding = (relations, box) => relations.reduce((count, [name, a, b]) => count + Number(HOLDS[name](a ?? box, b ?? box)), 0);

const isBetter = (a, b) => (b.holding - a.holding || a.far - b.far) < 0;

/** The box that carries a load on a support: a larger cover, or the support itself. */
function carrier(support, load, boxes) {
  const isCover = (box) => box.on?.id === support.id && box.size.z <= FLAT && area(box) >= COVER * area(support);
  const found = boxes.find((box) => isCover(box) && area(box) > area(load));
  return found ? carrier(found, load, boxes) : support;
}

const onTop = (box, support, overhang) =>
  over(box, support, overhang, support.within ?? [], () => top(support)).map((spot) => ({ ...spot, on: support }));

/** Spots in a container: on its bottom, or on other contents. */
function inside(box, container, boxes) {
  const contents = boxes.filter(({ within }) => within?.includes(container.id));
  const own = wider(box, 0);
  const bottom = (x, y) => Math.max(container.z, ...contents.filter((other) => overlap({ ...own, x, y }, other)).map(top));
  return over(box, container, false, [container.id, ...(container.within ?? [])], bottom)
    .filter(({ z }) => z === container.z || z + box.size.z <= top(container));
}

/** Spots over a box, within its face or, with an overhang, with the centre over it. Its centre and low spots come first. */
function over(box, lower, overhang, within, bottom) {
  const half = halves({ size: box.size, yaw: box.yaw - lower.yaw });
  const reach = (axis) => (overhang ? lower.size[axis] / 2 : Math.max(0, lower.size[axis] / 2 - half[axis]));
  const [c, s] = [Math.cos(radians(lower.yaw)), Math.sin(radians(lower.yaw))];
  return ON_FACE.flatMap((p) => ON_FACE.map((q) => {
    const [u, v] = [p * reach('x'), q * reach('y')];
    const [x, y] = [lower.x + u * c - v * s, lower.y + u * s + v * c];
    const z = bottom(x, y);
    return { x, y, z, far: Math.hypot(u, v) + z, within, holding: 0 };
  }));
}

const spotAt = (near, x, y, z) => ({ x, y, z, far: Math.hypot(x - near.x, y - near.y), within: [], holding: 0 });

/** Spots on the floor in front of the viewer. */
const onFloor = (box, side, near) => ON_FLOOR.flatMap((p) => ON_FLOOR.map((q) =>
  spotAt(near, AROUND + box.half.x + ((p + 1) * side) / 2, (q * side) / 2, 0)));

/** Height of the bottom of a hanging box; 0 for other boxes. */
const hanging = (box) => (box.hangs ? Math.max(0, EYES - box.size.z / 2) : 0);

/** Spots on the walls behind, to the left and to the right of all standing boxes. */
function onWall(box, boxes, near) {
  const standing = boxes.filter(({ hangs }) => !hangs);
  const edge = (axis, sign) => Math.max(0, ...standing.map((other) => sign * other[axis] + other.half[axis]));
  const [back, left, right] = [edge('x', 1) + box.half.x, edge('y', 1) + box.half.y, -edge('y', -1) - box.half.y];
  return ON_FLOOR.flatMap((p) => [
    [back, (left + right + p * (left - right)) / 2], [(back * (p + 1)) / 2, left], [(back * (p + 1)) / 2, right],
  ].map(([x, y]) => spotAt(near, x, y, hanging(box))));
}

/** A box with a gap around it. It does not overlap boxes that only touch it. */
const wider = ({ size: { x, y, z }, ...box }, gap) => ({ ...box, size: { x: x + 2 * (gap - TOUCH), y: y + 2 * (gap - TOUCH), z } });

/** A function that says whether a box at a spot, with a gap around it, reaches into no other box but its containers. */
function freedom(box, boxes, gap) {
  const wide = wider(box, gap);
  const half = halves(wide);
  const reaches = ({ x, y, z, within }, other) =>
    other.z < z + box.size.z - TOUCH && top(other) > z + TOUCH &&
    Math.abs(other.x - x) < half.x + other.half.x && Math.abs(other.y - y) < half.y + other.half.y &&
    !within.includes(other.id) && overlap({ ...wide, x, y }, other);
  const obstacles = [{ ...ROBOT, half: halves(ROBOT) }, ...boxes];
  return (spot) => !obstacles.some((other) => reaches(spot, other));
}

/** Whether a relation of two boxes holds, by the service's rules for boxes along the axes of the viewer. */
const HOLDS = {
  left: (a, b) => a.y - b.y >= Math.max(LEAST_OFFSET, Math.abs(a.x - b.x)) && areBeside(a, b),
  front: (a, b) => b.x - a.x >= LEAST_OFFSET && b.x - a.x > Math.abs(a.y - b.y) && areBeside(a, b),
  'on-top': (a, b) => Math.abs(a.z - top(b)) <= CONTACT && areStacked(a, b),
  above: (a, b) => a.z - top(b) > CONTACT && areStacked(a, b),
  inside: (a, b) => Boolean(a.within?.includes(b.id)),
};

/** The length along an axis that two footprints share; negative for a gap between them. */
const shared = (a, b, axis) =>
  Math.min(a.half[axis] + b.half[axis] - Math.abs(a[axis] - b[axis]), 2 * a.half[axis], 2 * b.half[axis]);

function areStacked(a, b) {
  const [x, y] = [shared(a, b, 'x'), shared(a, b, 'y')];
  return x > 0 && y > 0 && x * y >= LEAST_OVERLAP * Math.min(area(a), area(b));
}

const areBeside = (a, b) =>
  Math.hypot(Math.min(0, shared(a, b, 'x')), Math.min(0, shared(a, b, 'y'))) <= NEIGHBOURS && !areStacked(a, b);
