/**
 * The scenes of an opened recording: a list that marks alarms and confirmed scenes, and buttons that
 * lead to the next scene, and to the next scene with an alarm.
 */

import { call } from './api.js';
import { el } from './dom.js';
import { alarmsOf, habitOf } from './habits.js';
import { asRequest } from './importing.js';
import { sizesOf, UNKNOWN_LABELS } from './questions.js';
import { fromScene, toScene } from './scene.js';
import { changed } from './store.js';
import { shown } from './words.js';

const AT_ONCE = 64; // scenes in a batch, so that other clients wait a few milliseconds only

/** @param {(index: number) => void} go puts a scene of the recording on the board */
export function createRecorded(store, records, go) {
  const [list, next, nextAlarm, status, enough] = ['scenes-of-file', 'next-scene', 'next-alarm', 'file-status', 'enough'].map((id) => document.getElementById(id));
  let lines = [];
  let current = 0;
  let alarms = []; // of each scene, as `alarmsOf` returns them; undefined until the service has answered
  let covered = new Map(); // habit → scene that covers it
  let asking = new AbortController();

  const habit = (alarm, { room_type: room }) => habitOf(alarm.about, room);
  /** The alarms of a scene that no confirmation covers. */
  const openOf = (index) => {
    const line = records.current(lines[index]);
    return line.confirmed ? [] : (alarms[index] ?? []).filter((one) => !covered.has(habit(one, line)));
  };
  const isOpen = (index) => openOf(index).length > 0;
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

  /** Finds the habits that confirmed scenes cover. A removed object is no habit. */
  function cover() {
    covered = new Map();
    lines.forEach((line, index) => {
      const now = records.current(line);
      if (!now.confirmed) return;
      const labels = new Set(now.objects.map((entry) => entry.label ?? entry));
      for (const one of alarms[index] ?? []) {
        const key = habit(one, now);
        if (!covered.has(key) && one.labels.every((label) => labels.has(label))) covered.set(key, `scene ${index + 1}`);
      }
    });
    const before = store.get().covered;
    if (covered.size !== before.size || [...covered].some(([key, by]) => before.get(key) !== by)) store.set({ covered });
  }

  /** Says how many habits are confirmed, and when none is left. */
  function habits(open) {
    const left = new Set(lines.flatMap((line, index) => openOf(index).map((one) => habit(one, records.current(line)))));
    const done = alarms.length === lines.length && !open && alarms.some((found) => found.length);
    if (done && enough.textContent !== ENOUGH) enough.textContent = ENOUGH;
    else if (!done) enough.textContent = '';
    const all = covered.size + left.size;
    return all ? `${covered.size} of ${all} ${all === 1 ? 'habit' : 'habits'} confirmed. ` : '';
  }

  function draw() {
    const several = lines.length > 1;
    for (const node of [list.parentElement, status]) node.hidden = !several;
    cover();
    next.hidden = current + 1 >= lines.length;
    next.textContent = `Next scene (${current + 2} of ${lines.length})`;
    const open = lines.filter((_, index) => isOpen(index)).length;
    const alarm = following();
    nextAlarm.hidden = !several || alarm === undefined;
    nextAlarm.textContent = `Next alarm (scene ${alarm + 1})`;
    const confirmed = several ? habits(open) : '';
    if (!several) {
      enough.textContent = '';
      return;
    }
    const known = alarms.length < lines.length ? `${alarms.length} of ${lines.length} scenes asked. ` : '';
    status.textContent = `${known}${confirmed}${open} of ${lines.length} scenes with an open alarm. On the board: ${shown(lines[current].scene_id)}.`;
    lines.forEach((line, index) => {
      const words = nameOf(line, index);
      if (list.options[index].textContent !== words) list.options[index].textContent = words;
    });
    list.value = current;
  }

  function nameOf(line, index) {
    return [index + 1, ...[line.room_type, about(line, index), line.scene_id].filter(Boolean).map((part) => shown(part))].join(' · ');
  }

  function about(line, index) {
    const now = records.current(line);
    if (now.confirmed) return '✓ confirmed';
    if (isOpen(index)) return `⚠ ${named(openOf(index))}`;
    const [first] = alarms[index] ?? [];
    return first ? `✓ covered by ${covered.get(habit(first, now))}` : '';
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

const ENOUGH = 'Enough is confirmed: adapt the model now (docs/own-home.md).';
const MOST_NAMED = 3;

/** The words of alarms, each once. */
function named(alarms) {
  const words = [...new Set(alarms.map((one) => one.words))];
  return (words.length > MOST_NAMED ? [...words.slice(0, MOST_NAMED), '…'] : words).join(', ');
}
