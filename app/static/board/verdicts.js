/** What a person says about the answers: an object belongs here, is there, or stands right. The scene is then confirmed. */

import { keyOf } from './edges.js';
import { accept } from './ghosts.js';
import { namesOf, SPOKEN } from './words.js';

const NEXT = 'Remove what does not belong here. Import, export downloads the confirmed scenes.';

/** @param {(label: string) => string | undefined} add puts an object on the board; returns its id */
export function createVerdicts(store, say, add) {
  const confirmed = () => ({ line: { ...store.get().line, confirmed: true } });
  const name = (id) => namesOf(store.get().things)(id);
  return {
    /** The objects of the board are the whole scene, and belong there. */
    sceneIsRight() {
      store.edit({ things: store.get().things.map((thing) => ({ ...thing, belongs: true })), ...confirmed() });
      say(`The scene is confirmed. ${NEXT}`);
    },
    /** An object that looked wrong belongs to the scene. */
    belongs(id) {
      const things = store.get().things.map((thing) => (thing.id === id ? { ...thing, belongs: true } : thing));
      store.edit({ things, ...confirmed() });
      say(`${name(id)} confirmed. ${NEXT}`);
    },
    /** An object that seemed to be missing is there. */
    isThere(label, ghost) {
      const id = ghost ? accept(store, ghost) : add(label);
      if (!id) return;
      store.set(confirmed()); // Undo restores the scene without the object and the confirmation.
      say(`${id} is on the board. The scene is confirmed. ${NEXT}`);
    },
    /** A relation that looked wrong is right. */
    standsRight(one) {
      store.edit({ right: [...store.get().right, keyOf(one)], ...confirmed() });
      say(`${name(one.subject)} ${SPOKEN[one.relation]} ${name(one.object)} confirmed. ${NEXT}`);
    },
  };
}
