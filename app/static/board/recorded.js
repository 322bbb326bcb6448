/**
 * The scenes of an opened recording: a list that marks alarms and confirmed scenes, and buttons that
 * lead to the next scene, and to the next scene with an alarm.
 */

import { call } from './api.js';
import { el } from './dom.js';
import { asRequest } from './importing.js';
import { sizesOf, UNKNOWN_LABELS } from './questions.js';
import { fromScene, toScene } from './scene.js';
import { changed } from './store.js';
import { wordOf } from './words.js';

const AT_ONCE = 64; // scenes in a batch, so that other clients wait a few milliseconds only

/** @param {(index: number) => void} go puts a scene of the recording on the board */
export function createRecorded(store, records, go) {
  const [list, next, nextAlarm, status] = ['scenes-of-file', 'next-scene', 'next-alarm', 'file-status'].map((id) => document.getElementById(id));
  let lines = [];
  let current = 0;
  let alarms = []; // of each scene: names of what raises an alarm; undefined until the service has answered
  let asking = new AbortController();

  const isOpen = (index) => alarms[index]?.length > 0 && !records.current(lines[index]).confirmed;
  const following = () => lines.map((_, step) => (current + 1 + step) % lines.length).find((index) => index !== current && isOpen(index));

  /** Asks the model on the board about all scenes. */
  async function ask() {
    asking.abort();
    asking = new AbortController();
    const { signal } = asking;
    alarms = [];
    for (let start = 0; start < lines.length; start += AT_ONCE) {
      const part = lines.slice(start, start + AT_ONCE);
      try {
        const bodies = part.map(bodyOf);
        const asked = bodies.filter(Boolean);
        const { results } = asked.length ? await call('outliers/batch', { scenes: asked }, signal) : { results: [] };
        bodies.forEach((body, index) => (alarms[start + index] = body ? alarmsOf(results.shift().result) : []));
      } catch (error) {
        if (signal.aborted) return;
        status.textContent = `The alarms of the file are unknown: ${error.message}`;
        return;
      }
      draw();
    }
  }

  /** The question about a recorded scene, as the board asks it; null for a scene without objects or with an error. */
  function bodyOf(line) {
    const { models: [model], sensitivity } = store.get();
    const sizes = sizesOf(store.get(), model);
    try {
      const board = fromScene(asRequest(line), sizes);
      if (!board.things.length) return null;
      const posed = !board.relations.length && board.things.some(({ placed }) => placed);
      return { ...toScene({ ...board, posed }, sizes), model, sensitivity, unknown_labels: UNKNOWN_LABELS, detail: 'scores' };
    } catch {
      return null; // The board shows the error of this scene.
    }
  }

  function draw() {
    const several = lines.length > 1;
    for (const node of [list.parentElement, status]) node.hidden = !several;
    next.hidden = current + 1 >= lines.length;
    next.textContent = `Next scene (${current + 2} of ${lines.length})`;
    const open = lines.filter((_, index) => isOpen(index)).length;
    const alarm = following();
    nextAlarm.hidden = !several || alarm === undefined;
    nextAlarm.textContent = `Next alarm (scene ${alarm + 1})`;
    if (!several) return;
    const known = alarms.length < lines.length ? `${alarms.length} of ${lines.length} scenes asked. ` : '';
    status.textContent = `${known}${open} of ${lines.length} scenes with an open alarm. On the board: ${lines[current].scene_id}.`;
    lines.forEach((line, index) => {
      const words = nameOf(line, index);
      if (list.options[index].textContent !== words) list.options[index].textContent = words;
    });
    list.value = current;
  }

  function nameOf(line, index) {
    const about = records.current(line).confirmed ? '✓ confirmed' : alarms[index]?.length ? `⚠ ${alarms[index].join(', ')}` : '';
    return [index + 1, line.room_type, about, line.scene_id].filter(Boolean).join(' · ');
  }

  next.addEventListener('click', () => go(current + 1));
  nextAlarm.addEventListener('click', () => {
    store.set({ tab: 'outliers' });
    go(following());
  });
  list.addEventListener('change', () => go(Number(list.value)));
  store.subscribe((state, previous) => lines.length > 1 && changed(state, previous, 'models', 'sensitivity', 'epoch') && void ask());

  return {
    draw,
    /** Shows the lines of a file, of which one is on the board. */
    open(found, index) {
      const isNew = found.length !== lines.length || found.some((line, number) => line.scene_id !== lines[number].scene_id);
      [lines, current] = [found, index];
      if (isNew) {
        list.replaceChildren(...lines.map((_, number) => el('option', { value: number })));
        asking.abort();
        alarms = [];
        if (lines.length > 1) void ask();
      }
      draw();
    },
  };
}

const MOST_NAMED = 3;

/** The words of the scene for outliers, and for the subjects of misplaced relations. */
function alarmsOf(answer) {
  if (!answer) return [];
  const { outliers, misplaced } = answer;
  const words = new Map(outliers.map((one) => [one.object, wordOf(one)]));
  const found = [...outliers.filter((one) => one.is_outlier).map(wordOf),
    ...misplaced.filter((one) => one.is_misplaced).map(({ subject }) => `place of ${words.get(subject) ?? subject}`)];
  const names = [...new Set(found)];
  return names.length > MOST_NAMED ? [...names.slice(0, MOST_NAMED), '…'] : names;
}
