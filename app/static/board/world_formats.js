/** Readers of formats with poses, as in the Python module `scene_client.world_formats`. */

import { isObject, numbers, text } from './detections.js';
import { areObjects, collect, fail, hasList } from './image_formats.js';
import { SceneError } from './scene.js';
import { boxBetween, detection, excluded, must, NO_TURN, radians, solidBox, turnOf, vector } from './sightings.js';

/** Header of a scene whose axes do not depend on a viewer. */
const FIXED = { frame_id: 'map' };

// --------------------------------------------------------------------------------------- CSV

/** Rows of a CSV file, as objects with the names of the columns in lower case. */
export class Table extends Array {}

export const LABEL_COLUMNS = ['label', 'name', 'class_name', 'class', 'class_id'];
const IMAGE_COLUMNS = ['image', 'image_id', 'filename', 'file_name', 'frame'];
const CORNERS = ['xmin', 'ymin', 'xmax', 'ymax'];
const NUMBER = /^[+-]?(\d+\.?\d*|\.\d+)([eE][+-]?\d+)?$/;
const AXES = ['x', 'y', 'z'];

const TABLE = {
  name: 'CSV',
  matches: (data) => data instanceof Table,
  parts(rows) {
    const column = IMAGE_COLUMNS.find((name) => rows[0] && name in rows[0]);
    const parts = new Map();
    Array.from(rows).forEach((row, index) => {
      if (column && !(column in row)) throw new TypeError('a row has no image');
      collect(parts, column ? row[column] : '', { line: index + 2, row });
    });
    return parts;
  },
  read: (rows) => ({ detections: rows.map(({ line, row }) => rowOf(line, row)) }),
};

function rowOf(line, row) {
  const cell = (names) => names.map((name) => row[name]).find(Boolean) ?? '';
  const value = (...names) => {
    const found = cell(names);
    if (NUMBER.test(found)) return Number(found);
    if (!found || ['nan', 'null', 'none'].includes(found.toLowerCase())) return null;
    throw new SceneError(`Line ${line}, column ${names[0]}: “${found.slice(0, 40)}” is not a number.`);
  };
  const score = cell(['confidence', 'score']) ? value('confidence', 'score') : 1;
  let box = {};
  if (AXES.some((axis) => row[axis])) {
    const sizes = AXES.map((axis) => value(`s${axis}`));
    const turn = turnOf(value('yaw') ?? 0);
    box = solidBox(AXES.map((axis) => value(axis)), sizes.includes(null) ? null : sizes, turn);
  } else if (CORNERS.some((name) => row[name])) {
    const [left, top, right, bottom] = CORNERS.map((name) => value(name));
    box = boxBetween([left, right], [top, bottom]);
  }
  return detection(cell(LABEL_COLUMNS), score, row.id ?? '', box);
}

// ---------------------------------------------------------------------------------- AI2-THOR

const metadata = (data) => (isObject(data) ? (isObject(data.metadata) ? data.metadata : data) : {});

/** A point of Unity, left-handed with y up, as x forward, y left and z up. */
function fromUnity(point) {
  const { x, y, z } = numbers(point, 'xyz') ?? fail();
  return [z, -x, y];
}

function thorBox({ position, rotation, axisAlignedBoundingBox: box }) {
  if (!box?.size) return solidBox(fromUnity(position), null, turnOf(-radians(rotation?.y ?? 0)));
  return solidBox(fromUnity(box.center), fromUnity(box.size).map(Math.abs));
}

const AI2_THOR = {
  name: 'AI2-THOR',
  matches: (data) => areObjects(metadata(data).objects, 'objectType', 'position'),
  read(data) {
    const { objects, agent } = metadata(data);
    const visible = objects.filter(({ visible }) => visible !== false);
    const [x, y] = agent?.position && agent.rotation ? fromUnity(agent.position) : [];
    return {
      detections: visible.map((thing) => detection(thing.objectType, 1, thing.objectId ?? '', thorBox(thing))),
      header: FIXED,
      viewpoint: x === undefined ? null : { x, y, yaw: -radians(agent.rotation.y) },
      notes: excluded(objects.length - visible.length, 'objects that are not visible'),
    };
  },
};

// ------------------------------------------------------------------------------------- Hydra

const typeOf = (node) => String(node.attributes.type);

/** The name of the room that contains a node, or '' without a room. */
function roomOf(node, parents) {
  let found = node;
  for (let step = 0; step < 8; step += 1) { // an invalid graph can have a circle
    found = parents.get(found);
    if (!found) return '';
    if (typeOf(found).includes('Room')) return String(found.attributes.name || found.id);
  }
  return '';
}

const HYDRA = {
  name: 'Hydra',
  matches: (data) => hasList(data, 'edges') && hasList(data, 'nodes') && isObject(data.nodes[0]) && 'attributes' in data.nodes[0],
  parts(data) {
    const nodes = new Map(data.nodes.map((node) => [node.id, node]));
    const parents = new Map();
    for (const { source, target } of data.edges) {
      const ends = [nodes.get(source), nodes.get(target)];
      if (!ends[0] || !ends[1] || ends[0].layer === ends[1].layer) continue;
      const [low, high] = ends.sort((a, b) => must(a.layer) - must(b.layer));
      parents.set(low, high);
    }
    const parts = new Map();
    for (const node of data.nodes) {
      if (typeOf(node).includes('Object')) collect(parts, roomOf(node, parents), node);
    }
    return new Map([...parts].map(([room, objects]) => [room, { data, objects }]));
  },
  read({ data, objects }) {
    const spaces = data.metadata?.labelspaces ?? {};
    const names = new Map(spaces[Object.keys(spaces).sort().find((key) => key.startsWith('_l2'))] ?? []);
    return { detections: objects.map(({ attributes }) => hydraObject(attributes, names)), header: FIXED };
  },
};

function hydraObject({ bounding_box: given, semantic_label: label = fail(), position, name }, names) {
  const box = given ?? {};
  let [centre, size] = [vector(box.world_P_center), vector(box.dimensions)];
  if (!size && box.max) size = vector(box.max).map((high, index) => must(high) - must(vector(box.min)[index])); // before version 1.0.3
  const turn = numbers(box.world_R_center, 'xyzw');
  if (!centre || !size?.some(Boolean)) [centre, size] = [vector(position), null];
  return detection(names.get(label) ?? label, 1, name ?? '', solidBox(centre, size, turn ? Object.values(turn) : NO_TURN));
}

// ----------------------------------------------------------------------------------- ScanNet

/** A box that stands on the side whose axis is nearest to the vertical. */
function upright({ centroid, axesLengths: lengths, normalizedAxes: flat }) {
  if (!Array.isArray(lengths) || lengths.length < 3) fail();
  const axes = [0, 3, 6].map((first) => flat.slice(first, first + 3));
  const up = [0, 1, 2].reduce((best, axis) => (Math.abs(must(axes[axis][2])) > Math.abs(axes[best][2]) ? axis : best), 0);
  const [across, along] = [0, 1, 2].filter((axis) => axis !== up);
  return solidBox(centroid, [across, along, up].map((axis) => lengths[axis]), turnOf(Math.atan2(must(axes[across][1]), must(axes[across][0]))));
}

const SCANNET = {
  name: 'ScanNet',
  matches: (data) => hasList(data, 'segGroups'),
  read: ({ segGroups }) => ({
    detections: segGroups.map(({ label = fail(), objectId, id, obb }) =>
      detection(label, 1, `${text(label)}_${text(objectId === undefined ? id : objectId)}`, obb == null ? {} : upright(obb))),
    header: FIXED,
  }),
};

// ------------------------------------------------------------------------------------ MoveIt

/** Type of a shape_msgs/SolidPrimitive: extents in x, y and z. */
const SIDES = {
  1: (box) => box.slice(0, 3),
  2: ([radius]) => [2 * must(radius), 2 * radius, 2 * radius],
  3: ([height, radius]) => [2 * must(radius), 2 * radius, height],
  4: ([height, radius]) => [2 * must(radius), 2 * radius, height],
};
const REMOVE = 1; // operation of a CollisionObject
const SIGNS = [-1, 1].flatMap((a) => [-1, 1].flatMap((b) => [-1, 1].map((c) => [a, b, c])));

const collisionObjects = (data) => {
  const scene = data?.scene || data;
  const found = (scene?.world || scene)?.collision_objects;
  return Array.isArray(found) ? found : null;
};

const MOVEIT = {
  name: 'MoveIt',
  matches: (data) => collisionObjects(data) !== null,
  read(data) {
    const held = (data.scene || data).robot_state?.attached_collision_objects ?? [];
    const objects = [...collisionObjects(data), ...held.map((one) => one?.object)].map((thing) => (isObject(thing) ? thing : {}));
    const kept = objects.filter((thing) => thing.operation !== REMOVE);
    return {
      detections: kept.map((thing) =>
        detection(thing.type?.key || thing.id, 1, thing.id, collisionBox(thing), thing.header?.frame_id || '')),
      notes: excluded(objects.length - kept.length, 'removed objects'),
    };
  },
};

/** The box of a shape, or the box around several shapes in the frame of the object. */
function collisionBox(thing) {
  const [at, turn] = poseOf(thing.pose);
  const shapes = [['primitives', 'primitive_poses'], ['meshes', 'mesh_poses']].flatMap(([solids, poses]) =>
    (thing[solids] ?? []).map((solid, index) => [...poseOf(thing[poses]?.[index]), ...extent(solid)]));
  if (!shapes.length) return solidBox(at, null, turn);
  if (shapes.length === 1) {
    const [[shapeAt, shapeTurn, middle, size]] = shapes;
    return solidBox(sum(at, turned(turn, sum(shapeAt, turned(shapeTurn, middle)))), size, product(turn, shapeTurn));
  }
  const corners = shapes.flatMap(([shapeAt, shapeTurn, middle, size]) =>
    SIGNS.map((signs) => sum(shapeAt, turned(shapeTurn, sum(middle, signs.map((sign, axis) => (sign * size[axis]) / 2))))));
  const [low, high] = [Math.min, Math.max].map((choose) => corners.reduce((a, b) => a.map((value, axis) => choose(value, b[axis]))));
  const middle = low.map((value, axis) => (value + high[axis]) / 2);
  return solidBox(sum(at, turned(turn, middle)), low.map((value, axis) => high[axis] - value), turn);
}

/** The centre and the extents of a primitive or of a mesh in its own frame. */
function extent({ type, dimensions, vertices }) {
  if (!vertices) return [[0, 0, 0], (SIDES[type] ?? fail())(dimensions)];
  const spans = AXES.map((axis) => vertices.map((vertex) => must(vertex[axis])).reduce(([a, b], v) => [Math.min(a, v), Math.max(b, v)], [Infinity, -Infinity]));
  return [spans.map(([low, high]) => (low + high) / 2), spans.map(([low, high]) => high - low)];
}

/** The position and the rotation of a pose. An unset pose is the identity. */
function poseOf(pose) {
  const at = Object.values(numbers(pose?.position, 'xyz') ?? { x: 0, y: 0, z: 0 });
  const turn = Object.values(numbers(pose?.orientation, 'xyzw') ?? {});
  const length = Math.hypot(...turn);
  return [at, length > 0 ? turn.map((value) => value / length) : NO_TURN];
}

const sum = (a, b) => a.map((value, axis) => value + b[axis]);

/** The rotation by q and then by p. */
const product = ([a, b, c, d], [x, y, z, w]) => [
  d * x + a * w + b * z - c * y,
  d * y - a * z + b * w + c * x,
  d * z + a * y - b * x + c * w,
  d * w - a * x - b * y - c * z,
];

const turned = (turn, point) => product(product(turn, [...point, 0]), [-turn[0], -turn[1], -turn[2], turn[3]]).slice(0, 3);

export const WORLD_FORMATS = [TABLE, AI2_THOR, HYDRA, SCANNET, MOVEIT];
