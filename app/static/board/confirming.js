/**
 * Sends confirmed scenes to a service that records them (`POST /confirm`). Other services lack the
 * route; then the user downloads the scenes.
 */

import { call, ProblemError, UnreachableError } from './api.js';
import { UNKNOWN_LABELS } from './questions.js';
import { changed } from './store.js';

const STILL = 2000; // ms without a change; the recording of the service cannot take a scene back
/** The fields of a recorded scene that a request may have. */
const FIELDS = [
  'scene_id', 'group', 'source', 'confirmed', 'viewer_frame', 'objects', 'relations', 'room_type', 'stamp',
  'up', 'units', 'extents', 'box_origin',
];

/** @param {() => void} whenChanged */
export function createSender(store, whenChanged) {
  const waiting = new Map(); // scene_id → confirmed line that the service does not have
  const sent = new Map(); // scene_id → its id in the recording of the service
  const refused = new Map(); // scene_id → words
  let takes = null; // whether the service has the route; null: not asked yet
  let timer = 0;

  function bodyOf(line) {
    const fields = FIELDS.filter((name) => line[name] !== undefined).map((name) => [name, line[name]]);
    return {
      ...Object.fromEntries(fields), ...(line.relations && { relations_complete: true }),
      model: store.get().models[0], unknown_labels: UNKNOWN_LABELS,
    };
  }

  async function send() {
    clearTimeout(timer);
    if (!waiting.size || takes === false) return;
    try {
      takes ??= Boolean((await call('openapi.json')).paths['/confirm']);
      for (const [id, line] of takes ? [...waiting] : []) {
        waiting.delete(id);
        await post(id, line);
      }
    } catch (error) {
      if (error instanceof UnreachableError) store.set({ down: true });
      else if (error instanceof ProblemError) takes = error.problem.status === 404 ? false : takes;
      else throw error;
    }
    whenChanged();
  }

  async function post(id, line) {
    try {
      sent.set(id, (await call('confirm', bodyOf(line))).scene_id);
      refused.delete(id);
    } catch (error) {
      if (error instanceof UnreachableError && !waiting.has(id)) waiting.set(id, line);
      if (!(error instanceof ProblemError) || error.problem.status === 404) throw error;
      refused.set(id, error.problem.detail ?? error.message);
    }
  }

  // A scene that leaves the board is complete. After a failure, the page sends again when the service answers.
  store.subscribe((state, previous) => {
    if (changed(state, previous, 'epoch') || state.line.scene_id !== previous.line?.scene_id) void send();
  });

  return {
    keep(line) {
      if (takes === false) return;
      waiting.set(line.scene_id, line);
      clearTimeout(timer);
      timer = setTimeout(send, STILL);
    },
    drop(id) {
      waiting.delete(id);
      refused.delete(id);
    },
    /** What the service knows about a scene, in words; '' for a service without the route. */
    words({ scene_id: id, confirmed }) {
      if (!confirmed) return sent.has(id) ? `The recording of the service still has this scene as confirmed (${sent.get(id)}).` : '';
      if (refused.has(id)) return `The service refuses it: ${refused.get(id)}`;
      return takes && sent.has(id) && !waiting.has(id) ? 'The service has recorded it.' : '';
    },
  };
}
