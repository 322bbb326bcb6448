/**
 * The state of the page: one plain object, replaced as a whole at every change. Views compare
 * references to see whether their parts have changed.
 *
 * @typedef {{x: number, y: number, z: number}} Extents metres
 * @typedef {object} Thing an object on the board
 * @property {string} id
 * @property {string} label
 * @property {number} x ahead, metres, of its centre
 * @property {number} y to the left
 * @property {number} z of its bottom
 * @property {Extents | null} size along its own axes; null: typical of its class
 * @property {number} yaw degrees, from x towards y
 * @property {number} confidence
 * @property {boolean} placed whether its position comes from the scene or the user, not from the page
 * @property {{label: string, confidence: number}[]} [alternatives] other labels of the detector
 * @property {boolean} [belongs] whether the user confirmed that it belongs here
 * @property {object} [source] its entry in the opened file, and the object as it was then
 */

/**
 * @template {object} State
 * @param {State} initial
 */
export function createStore(initial) {
  let state = initial;
  const listeners = new Set();
  const past = [];
  return {
    get: () => state,
    /** Changes parts of the state. @param {Partial<State>} change */
    set(change) {
      const previous = state;
      state = { ...state, ...change };
      for (const listener of listeners) listener(state, previous);
    },
    /** Changes the board, so that `undo` can restore its previous state. */
    edit(change) {
      const { things, relations, posed, viewer, room, line, right } = state;
      past.push({ things, relations, posed, viewer, room, line, right });
      if (past.length > 200) past.shift();
      this.set({ complaint: '', ...change, canUndo: true });
    },
    undo() {
      const before = past.pop();
      if (before) this.set({ ...before, canUndo: past.length > 0, at: null });
    },
    subscribe(listener) {
      listeners.add(listener);
    },
  };
}

/** Whether one of these parts of the state has changed. */
export const changed = (state, previous, ...keys) =>
  keys.some((key) => state[key] !== previous[key]);
