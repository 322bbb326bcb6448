/** Places for objects without a position, from the relations between them. */

import { halves, round } from './geometry.js';

const ROBOT = '\u0000robot'; // node that keeps objects away from the robot; not a valid object id
const TICKS = 260;
const GAP = 0.12; // metres
/** The canonical form of each relation, and whether its ends are exchanged. */
const CANONICAL = {
  left: ['left', false], right: ['left', true], front: ['front', false], behind: ['front', true],
  'on-top': ['on-top', false], under: ['on-top', true], above: ['above', false], below: ['above', true],
  inside: ['inside', false], contains: ['inside', true],
};

function canonical(relations) {
  return relations.map(({ subject, relation, object }) => {
    const [name, swapped] = CANONICAL[relation];
    return swapped ? [object, name, subject] : [subject, name, object];
  });
}

/** The support or container of each object, and its relation: the first one stated, unless this would make a cycle. */
function supports(triples, movable) {
  const on = new Map();
  for (const [subject, name, object] of triples) {
    if (!['on-top', 'above', 'inside'].includes(name) || on.has(subject) || !movable.has(subject)) continue;
    let below = object;
    while (below !== undefined && below !== subject) below = on.get(below)?.object;
    if (below === undefined && subject !== object) on.set(subject, { object, name });
  }
  return on;
}

/**
 * A force that moves subjects to the left or to the front of their objects.
 * @param {[string, string, string][]} triples
 */
function beside(triples, nodes) {
  const by = new Map(nodes.map((node) => [node.id, node]));
  const pairs = triples
    .filter(([subject, name, object]) => ['left', 'front'].includes(name) && by.has(subject) && by.has(object))
    .map(([subject, name, object]) => [by.get(subject), name === 'left' ? 'y' : 'x', by.get(object), name]);
  return (alpha) => {
    for (const [a, axis, b, name] of pairs) {
      const sign = name === 'left' ? 1 : -1;
      const wanted = a.half[axis] + b.half[axis] + GAP;
      const lacking = wanted - sign * (a[axis] - b[axis]);
      if (lacking > 0) {
        a[`v${axis}`] += sign * lacking * 0.3 * alpha;
        b[`v${axis}`] -= sign * lacking * 0.3 * alpha;
      }
      // Related objects attract each other.
      for (const each of ['x', 'y']) {
        const pull = (b[each] - a[each]) * 0.04 * alpha;
        a[`v${each}`] += pull;
        b[`v${each}`] -= pull;
      }
    }
  };
}

/**
 * Places `free` boxes among `fixed` boxes.
 * @param {object[]} fixed
 * @param {object[]} free boxes; given x and y are the start of the search
 * @param {{subject: string, relation: string, object: string}[]} relations by id
 * @returns {object[]} the free ones, placed
 */
export function layOut(fixed, free, relations, viewer) {
  const triples = canonical(relations);
  const on = supports(triples, new Set(free.map((box) => box.id)));
  const middle = { x: viewer.x + 2.4 * Math.cos(viewer.yaw), y: viewer.y + 2.4 * Math.sin(viewer.yaw) };
  const standing = free.filter((box) => !on.has(box.id));
  const ground = fixed.filter((box) => box.z < 0.3);
  const nodes = [
    { id: ROBOT, half: { x: 0.2, y: 0.2 }, x: viewer.x, y: viewer.y, fx: viewer.x, fy: viewer.y },
    ...ground.map((box) => ({ id: box.id, half: halves(box), x: box.x, y: box.y, fx: box.x, fy: box.y })),
    ...standing.map((box, index) => ({
      id: box.id,
      half: halves(box),
      // A spiral in a fixed order, so that the same relations give the same layout.
      x: box.x ?? middle.x + 0.35 * Math.sqrt(index) * Math.cos(2.4 * index),
      y: box.y ?? middle.y + 0.35 * Math.sqrt(index) * Math.sin(2.4 * index),
    })),
  ];
  d3.forceSimulation(nodes)
    .alphaDecay(1 - 0.002 ** (1 / TICKS))
    .force('beside', beside(triples, nodes))
    .force('apart', d3.forceCollide((node) => Math.hypot(node.half.x, node.half.y) + GAP / 2).iterations(2))
    .force('x', d3.forceX(middle.x).strength(0.02))
    .force('y', d3.forceY(middle.y).strength(0.02))
    .stop()
    .tick(TICKS);
  const placed = new Map(fixed.map((box) => [box.id, box]));
  const by = new Map(nodes.map((node) => [node.id, node]));
  for (const box of standing) {
    const { x, y } = by.get(box.id);
    placed.set(box.id, { ...box, x: round(x), y: round(y), z: 0 });
  }
  stack(free.filter((box) => on.has(box.id)), on, placed, middle);
  return free.map((box) => placed.get(box.id));
}

/** Puts boxes on their supports and into their containers, side by side. */
function stack(boxes, on, placed, middle) {
  const count = new Map();
  let waiting = boxes;
  while (waiting.length) {
    const ready = waiting.filter((box) => placed.has(on.get(box.id).object));
    // If the support is not on the board, the floor replaces it.
    for (const box of ready.length ? ready : waiting) {
      const { object, name } = on.get(box.id);
      const below = placed.get(object) ?? { ...middle, z: 0, yaw: 0, size: { x: 1, y: 1, z: 0 } };
      const number = count.get(object) ?? 0;
      count.set(object, number + 1);
      const [half, own] = [halves(below), halves(box)];
      // Contents stay within the footprint of their container.
      const room = (axis) => Math.min(0.65 * half[axis], name === 'inside' ? Math.max(0, half[axis] - own[axis]) : Infinity);
      const [x, y] = number ? [room('x') * Math.sin(2.4 * number), room('y') * Math.cos(2.4 * number)] : [0, 0];
      const z = name === 'inside' ? below.z : below.z + below.size.z;
      placed.set(box.id, { ...box, x: round(below.x + x), y: round(below.y + y), z: round(z) });
    }
    waiting = ready.length ? waiting.filter((box) => !placed.has(box.id)) : [];
  }
}

