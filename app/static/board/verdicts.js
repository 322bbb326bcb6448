/**
 * What a person says about the answers. A verdict is about one object or one relation. It confirms the
 * scene only if no other alarm is open, because a confirmed scene teaches all its objects.
 */

import { keyOf, openAlarms } from './edges.js';
import { accept } from './ghosts.js';
import { namesOf, SPOKEN } from './words.js';

const CONFIRMED = 'The scene is confirmed. Import, export downloads the confirmed scenes.';

/** @param {(label: string) => string | undefined} add puts an object on the board; returns its id */
export function createVerdicts(store, say, add) {
  const name = (id) => namesOf(store.get().things)(id);
  const marked = (ids) => store.get().things.map((thing) => (ids.includes(thing.id) ? { ...thing, belongs: true } : thing));

  /** Adds a verdict. The scene is confirmed if the answer has no alarm without a verdict. */
  function judge(change, words) {
    const state = { ...store.get(), ...change };
    const isConfirmed = state.line.confirmed || openAlarms(state) === 0;
    const result = { ...change, ...(isConfirmed && { line: { ...state.line, confirmed: true } }) };
    store.edit(result);
    say(`${words} ${isConfirmed ? CONFIRMED : statusOf(store.get())}`);
  }

  return {
    /** The objects of the board are the whole scene, belong there, and stand right. */
    sceneIsRight() {
      store.edit({ line: { ...store.get().line, confirmed: true } });
      say(CONFIRMED);
    },
    /** An object that looked wrong belongs to the scene. */
    belongs(id) {
      judge({ things: marked([id]) }, `${name(id)} confirmed.`);
    },
    /** An object that seemed to be missing is there. */
    isThere(label, ghost) {
      const isConfirmed = store.get().line.confirmed || openAlarms(store.get()) === 0;
      const id = ghost ? accept(store, ghost) : add(label);
      if (!id) return;
      // Undo restores the scene without the object and the confirmation.
      store.set({ things: marked([id]), line: { ...store.get().line, ...(isConfirmed && { confirmed: true }) } });
      say(`${id} is on the board. ${isConfirmed ? CONFIRMED : statusOf(store.get())}`);
    },
    /** A relation that looked wrong is right. */
    standsRight(one) {
      judge({ right: [...store.get().right, keyOf(one)] },
        `${name(one.subject)} ${SPOKEN[one.relation]} ${name(one.object)} confirmed.`);
    },
  };
}

/** Whether a person has given a verdict about the scene. */
export const isJudged = ({ things, right }) => right.length > 0 || things.some(({ belongs }) => belongs);

/** What a person has to do until a scene with a verdict is confirmed. */
export function statusOf(state) {
  const open = openAlarms(state);
  const alarms = open ? `${open} more ${open === 1 ? 'alarm is' : 'alarms are'} open: confirm or remove. ` : '';
  return `The scene is not confirmed yet. ${alarms}Then choose “This scene is right”.`;
}
