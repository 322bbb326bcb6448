/** Example scenes in the format of the API. */

const at = (x, y, z) => ({ x, y, z });
const thing = (label, position, size, id = label) => ({ id, label, position, size });
const scene = (room_type, objects) => ({ objects, room_type, frame_id: 'map', viewpoint: { x: 0, y: 0, yaw: 0 } });

export const EXAMPLES = {
  'A bedroom with something wrong in it': scene('bedroom', [
    thing('bed', at(2.6, 0.1, 0.3), at(2.0, 1.6, 0.6)),
    thing('nightstand', at(3.35, 1.25, 0.28), at(0.45, 0.45, 0.56)),
    thing('lamp', at(3.35, 1.25, 0.78), at(0.25, 0.25, 0.44)),
    thing('wardrobe', at(1.6, 2.1, 1.0), at(1.4, 0.6, 2.0)),
    thing('oven', at(3.2, -1.55, 0.45), at(0.6, 0.6, 0.9)),
  ]),
  'A kitchen being tidied': scene('kitchen', [
    thing('counter', at(3.3, 0.7, 0.45), at(0.6, 2.4, 0.9)),
    thing('sink', at(3.3, 1.4, 1.0), at(0.4, 0.5, 0.2)),
    thing('stove', at(3.3, -0.9, 0.45), at(0.6, 0.6, 0.9)),
    thing('fridge', at(3.3, -1.75, 0.9), at(0.65, 0.7, 1.8)),
    thing('table', at(1.4, 0.3, 0.37), at(0.8, 1.2, 0.74)),
    thing('chair', at(0.75, 0.3, 0.45), at(0.45, 0.45, 0.9)),
    thing('mug', at(1.4, 0.6, 0.79), at(0.1, 0.1, 0.1)),
  ]),
  'A desk': scene('office', [
    thing('desk', at(1.7, 0, 0.37), at(0.8, 1.6, 0.74)),
    thing('monitor', at(1.85, 0.1, 0.97), at(0.15, 0.55, 0.46)),
    thing('keyboard', at(1.5, 0.1, 0.755), at(0.15, 0.42, 0.03)),
    thing('lamp', at(1.85, 0.62, 0.95), at(0.2, 0.2, 0.42)),
    thing('chair', at(0.95, 0.05, 0.45), at(0.5, 0.5, 0.9)),
  ]),
};
