/** Geometry of boxes: their footprints and supports. Metres; x ahead, y to the left. */

/** @typedef {import('./store.js').Thing} Thing */

/** Size of an object if neither the scene nor the model has one. */
export const UNKNOWN_SIZE = { x: 0.4, y: 0.4, z: 0.4 };

export const radians = (degrees) => (degrees * Math.PI) / 180;
export const round = (value, digits = 3) => Number(value.toFixed(digits));

/**
 * Half of the extents of a rotated box along x and y.
 * @param {{size: import('./store.js').Extents, yaw: number}} box
 */
export function halves(box) {
  const c = Math.abs(Math.cos(radians(box.yaw)));
  const s = Math.abs(Math.sin(radians(box.yaw)));
  return { x: (box.size.x * c + box.size.y * s) / 2, y: (box.size.x * s + box.size.y * c) / 2 };
}

function covers(box, x, y) {
  const a = radians(box.yaw);
  const [dx, dy] = [x - box.x, y - box.y];
  const along = dx * Math.cos(a) + dy * Math.sin(a);
  const across = dy * Math.cos(a) - dx * Math.sin(a);
  return Math.abs(along) <= box.size.x / 2 && Math.abs(across) <= box.size.y / 2;
}

/** The centre and the half extents of a box in the axes of another box. */
function local(box, other) {
  const a = radians(other.yaw);
  const [dx, dy] = [box.x - other.x, box.y - other.y];
  return {
    x: Math.abs(dx * Math.cos(a) + dy * Math.sin(a)), y: Math.abs(dy * Math.cos(a) - dx * Math.sin(a)),
    half: halves({ size: box.size, yaw: box.yaw - other.yaw }),
  };
}

/** Whether two footprints overlap: neither box has an axis that separates them. */
export function overlap(a, b) {
  return [[a, b], [b, a]].every(([box, other]) => {
    const { x, y, half } = local(box, other);
    return x < half.x + other.size.x / 2 && y < half.y + other.size.y / 2;
  });
}

/** Whether the footprint of a box lies inside that of another box. */
export function inside(box, other) {
  const { x, y, half } = local(box, other);
  return x + half.x <= other.size.x / 2 && y + half.y <= other.size.y / 2;
}

/** Whether the extents of a footprint are at most this share of those of another one. */
export function fits(box, other, share) {
  const half = halves({ size: box.size, yaw: box.yaw - other.yaw });
  return half.x <= share * (other.size.x / 2) && half.y <= share * (other.size.y / 2);
}

const HIGHEST = 1.2; // height of contents, as a share of that of their container, by the service's rule

/** Whether a box fits into a container. */
export const fitsInto = (box, container) => fits(box, container, 1) && box.size.z <= HIGHEST * container.size.z;

/** Distance between two separate footprints in metres: that of a corner to the other footprint. */
export function gap(a, b) {
  const distances = [[a, b], [b, a]].flatMap(([box, other]) => [[1, 1], [1, -1], [-1, 1], [-1, -1]].map(([p, q]) => {
    const [c, s] = [Math.cos(radians(box.yaw)), Math.sin(radians(box.yaw))];
    const [u, v] = [(p * box.size.x) / 2, (q * box.size.y) / 2];
    const corner = { x: box.x + u * c - v * s, y: box.y + u * s + v * c, size: { x: 0, y: 0 }, yaw: 0 };
    const { x, y } = local(corner, other);
    return Math.hypot(Math.max(0, x - other.size.x / 2), Math.max(0, y - other.size.y / 2));
  }));
  return Math.min(...distances);
}

const area = (box) => box.size.x * box.size.y;
const NEAR = 0.03;

/** The height of the support of a box: the top of the highest larger box under its centre. */
export function floorUnder(boxes, box) {
  let height = 0;
  for (const other of boxes) {
    if (other.id !== box.id && area(other) > area(box) && covers(other, box.x, box.y)) {
      height = Math.max(height, other.z + other.size.z);
    }
  }
  return height;
}

/** Whether a box lies inside another box. */
function contained(box, other) {
  return inside(box, other) && box.z >= other.z - NEAR && box.z + box.size.z <= other.z + other.size.z + NEAR;
}

/** The ids of all objects that rest on a box or lie inside it, directly or on each other. */
function riders(boxes, box, found = new Set()) {
  for (const other of boxes) {
    if (other.id === box.id || found.has(other.id) || area(other) >= area(box)) continue;
    const rests = Math.abs(other.z - (box.z + box.size.z)) < NEAR && covers(box, other.x, other.y);
    if (rests || contained(other, box)) {
      found.add(other.id);
      riders(boxes, other, found);
    }
  }
  return found;
}

/**
 * The objects after one of them was moved. Objects on it and in it move along, and it gets a new support.
 * @param {Thing[]} things
 * @param {(thing: Thing) => Thing & {size: import('./store.js').Extents}} sized
 */
export function moved(things, id, x, y, sized) {
  const boxes = things.map(sized);
  const box = boxes.find((other) => other.id === id);
  const carried = riders(boxes, box);
  const rested = Math.abs(box.z - floorUnder(boxes, box)) < NEAR;
  const others = boxes.filter((other) => !carried.has(other.id));
  const z = rested ? floorUnder(others, { ...box, x, y }) : box.z;
  const shift = { x: x - box.x, y: y - box.y, z: z - box.z };
  return things.map((thing) =>
    thing.id === id || carried.has(thing.id)
      ? {
          ...thing,
          placed: thing.placed || thing.id === id,
          x: round(thing.x + shift.x),
          y: round(thing.y + shift.y),
          z: round(thing.z + shift.z),
        }
      : thing,
  );
}
