/** Actions on objects, by mouse, touch or keyboard. */

import { floorUnder, moved, overlap, round } from './geometry.js';
import { openMenu } from './menu.js';
import { sizesOf } from './questions.js';
import { FULL, freePlace, MOST_OBJECTS, freshId, sizer } from './scene.js';
import { nameOf, SPOKEN } from './words.js';

/** Id of the robot, which moves like an object. Ids of objects are printable, so they differ from it. */
export const ROBOT = '\u0000robot';
const GRID = 0.05; // metres; objects that are dragged snap to it

/** A position in words, for screen readers. */
export function whereabouts(x, y, viewer = { x: 0, y: 0, yaw: 0 }) {
  const [dx, dy] = [x - viewer.x, y - viewer.y];
  const ahead = dx * Math.cos(viewer.yaw) + dy * Math.sin(viewer.yaw);
  const left = dy * Math.cos(viewer.yaw) - dx * Math.sin(viewer.yaw);
  const far = `${Math.abs(ahead).toFixed(1)} m ${ahead >= 0 ? 'ahead' : 'behind'}`;
  return Math.abs(left) < 0.05 ? far : `${far}, ${Math.abs(left).toFixed(1)} m ${left > 0 ? 'left' : 'right'}`;
}

/** @param {(id: string) => [string, () => void][]} more further entries of the menu of an object */
export function createActions(store, say, menu, more) {
  const sized = () => sizer(sizesOf(store.get(), store.get().models[0]));
  const find = (id) => store.get().things.find((thing) => thing.id === id);
  const named = (id) => nameOf(find(id) ?? { id, label: id });
  const snapped = (value) => round(Math.round(value / GRID) * GRID);

  function select(id) {
    if (store.get().selected !== id) store.set({ selected: id });
  }

  /**
   * @param {{x: number, y: number}} [at] position of the drop; without it, a free place
   * @returns {string | undefined} the id; undefined if the scene is full
   */
  function add(label, at) {
    const { things, viewer } = store.get();
    if (things.length >= MOST_OBJECTS) {
      store.set({ complaint: FULL });
      return undefined;
    }
    const id = freshId(things, label);
    const thing = { id, label, x: 0, y: 0, z: 0, size: null, yaw: 0, confidence: 1, placed: Boolean(at) };
    const boxes = things.map(sized());
    const box = sized()(thing);
    const place = at ? { x: snapped(at.x), y: snapped(at.y) } : freePlace(boxes, box.size, viewer);
    const z = round(floorUnder(boxes, { ...box, ...place }));
    store.edit({ things: [...things, { ...thing, ...place, z }], selected: id });
    say(`${id} added, ${whereabouts(place.x, place.y, viewer)}.`);
    return id;
  }

  function remove(id) {
    const { things, relations, at, selected } = store.get();
    const name = named(id);
    refocus(things.findIndex((thing) => thing.id === id));
    store.edit({
      things: things.filter((thing) => thing.id !== id),
      relations: relations.filter(({ subject, object }) => subject !== id && object !== id),
      selected: selected === id ? null : selected,
      at: at?.object === id ? null : at,
    });
    say(`${name} removed.`);
  }

  /** Gives an object another label, and the id of this label if its id was its label. */
  function rename(id, label) {
    const { things, relations, at, viewer } = store.get();
    const name = named(id);
    const own = id === find(id).label ? freshId(things, label) : id;
    const end = (name) => (name === id ? own : name);
    const { alternatives, ...thing } = find(id);
    const renamed = { ...thing, id: own, label };
    const box = sized()(renamed);
    const others = things.filter((thing) => thing.id !== id).map(sized());
    // The typical size of the new label may need another place.
    const meets = !box.placed && !box.z && others.some((other) => overlap(other, box));
    const place = meets ? freePlace(others, box.size, viewer) : {};
    refocus(things.findIndex((thing) => thing.id === id));
    store.edit({
      things: things.map((thing) => (thing.id === id ? { ...renamed, ...place } : thing)),
      relations: relations.map((one) => ({ ...one, subject: end(one.subject), object: end(one.object) })),
      selected: own,
      at: at && { ...at, object: end(at.object) },
    });
    say(`${name} renamed to ${nameOf(renamed)}.`);
  }

  /** Moves the focus to the next object after a removal, so that keyboard users keep their place. */
  function refocus(index) {
    const all = document.activeElement?.closest('#board') ? '#board .object' : '#list .name';
    // The caller changes the state first; its frame draws before this one.
    queueMicrotask(() => requestAnimationFrame(() => {
      if (document.activeElement !== document.body) return;
      const left = document.querySelectorAll(all);
      (left[Math.min(index, left.length - 1)] ?? document.getElementById('search')).focus();
    }));
  }

  /** @param {boolean} [again] whether the change continues a movement that undo already covers */
  function place(id, x, y, again = false, exactly = false) {
    const { things, viewer } = store.get();
    const [px, py] = exactly ? [round(x), round(y)] : [snapped(x), snapped(y)];
    const change = id === ROBOT
      ? { viewer: { ...viewer, x: px, y: py } }
      : { things: moved(things, id, px, py, sized()) };
    if (again) store.set(change);
    else store.edit(change);
  }

  function change(id, fields) {
    store.edit({ things: store.get().things.map((thing) => (thing.id === id ? { ...thing, ...fields } : thing)) });
  }

  function turn(id, degrees) {
    const { viewer } = store.get();
    if (id === ROBOT) {
      const whole = 2 * Math.PI;
      const yaw = round((((viewer.yaw + (degrees * Math.PI) / 180) % whole) + whole) % whole, 4);
      store.edit({ viewer: { ...viewer, yaw } });
      return;
    }
    const yaw = round((((find(id).yaw + degrees) % 360) + 360) % 360, 2);
    change(id, { yaw });
    say(`${named(id)} rotated to ${yaw} degrees.`);
  }

  const STEPS = { ArrowUp: [1, 0], ArrowDown: [-1, 0], ArrowLeft: [0, 1], ArrowRight: [0, -1] };

  /** Handles a key on an object of the board or the list. */
  function keys(event, id) {
    const thing = id === ROBOT ? store.get().viewer : find(id);
    if (!thing || store.get().draft || event.ctrlKey || event.metaKey) return;
    if (STEPS[event.key]) {
      const length = event.shiftKey ? 0.5 : event.altKey ? 0.01 : 0.1;
      const [x, y] = STEPS[event.key];
      place(id, thing.x + x * length, thing.y + y * length, false, true);
      const now = id === ROBOT ? store.get().viewer : find(id);
      say(`${id === ROBOT ? 'Robot' : named(id)}: x ${now.x.toFixed(2)}, y ${now.y.toFixed(2)}.`);
    } else if (event.key === 'r' || event.key === 'R') {
      turn(id, event.shiftKey ? -15 : 15);
    } else if (id !== ROBOT && (event.key === 'Delete' || event.key === 'Backspace')) {
      remove(id);
    } else if (id !== ROBOT && (event.key === 'ContextMenu' || (event.key === 'F10' && event.shiftKey))) {
      open(id, event.currentTarget);
    } else {
      return;
    }
    event.preventDefault();
  }

  function ask(relation, id) {
    store.set({ at: { relation, object: id }, tab: 'missing' });
    say(`Asking what is missing ${SPOKEN[relation]} ${named(id)}.`);
  }

  /** Opens the menu of an object at the pointer, or beside the element that opens it. */
  function open(id, opener, pointer) {
    if (store.get().draft) return;
    const box = opener.getBoundingClientRect();
    const at = pointer ?? { left: box.left + Math.min(box.width, 40), top: box.bottom };
    const asks = ['on-top', 'inside', 'under', 'left', 'right', 'front', 'behind'];
    select(id);
    openMenu(menu, opener, at, [
      ...more(id),
      ...asks.map((relation) => [`What is missing ${SPOKEN[relation]} it?`, () => ask(relation, id)]),
      ['Rotate by 90°', () => turn(id, 90)],
      ['Add another object of this class', () => add(find(id).label)],
      ['Remove', () => remove(id)],
    ], `Actions for ${named(id)}`);
  }

  return { select, add, remove, rename, place, change, keys, open, find, sized };
}
