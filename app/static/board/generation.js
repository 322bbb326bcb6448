/**
 * Scenes drawn by the model, sweep by sweep.
 *
 * A chain of fewer sweeps with the same seed is the beginning of a chain with more: so asking for 1,
 * 2, 3 … sweeps shows one chain at work. Its relations are drawn at the end of every request anew.
 */

import { call, ProblemError, UnreachableError } from './api.js';
import { calls, problemWords } from './columns.js';
import { el, redraw } from './dom.js';
import { layOut } from './layout.js';
import { sizesOf } from './questions.js';
import { freshId, FULL, MOST_OBJECTS, sizer, toScene } from './scene.js';
import { changed } from './store.js';
import { SPOKEN } from './words.js';

const SWEEPS = [1, 2, 3, 4, 6, 8, 12, 16, 24, 32, 50];
const PACE = 700; // ms between sweeps while playing
const UNITS = 24; // contexts that are listed at once

const nameOf = (unit) => unit.objects.slice(0, 3).map(({ label }) => label).join(', ');

export function createGeneration(form, drawn, store, say) {
  const field = (name) => form.elements.namedItem(name);
  const units = document.getElementById('units');
  const find = document.getElementById('context-search');
  const contextsOf = (state) => state.contexts[state.models[state.shown]];
  let held = {}; // layer → set of units
  let frames = [];
  let controller = new AbortController();
  let timer = 0;

  const shown = { calls: calls() };
  shown.words = el('output', { for: 'sweep' });
  shown.range = el('input', { type: 'range', id: 'sweep', min: 0, step: 1, oninput: () => frame(Number(shown.range.value)) });
  shown.play = el('button', { type: 'button', onclick: () => (timer ? stop() : play()) }, 'Play');
  shown.problem = el('div', { class: 'problem', role: 'alert', hidden: true });
  shown.detail = el('div');
  shown.node = el('div', { hidden: true },
    el('label', { class: 'slider' }, 'Sweep ', shown.range, shown.words), el('div', { class: 'row' }, shown.play),
    shown.detail, shown.calls.node,
    el('p', { class: 'quiet' }, 'One chain, stopped after so many sweeps: objects and contexts go on from stop to stop; relations are drawn anew at each.'));
  drawn.append(shown.problem, shown.node);

  function bodyOf(state, steps) {
    const withBoard = field('evidence').checked;
    const { room_type: _, ...scene } = toScene(state, sizesOf(state, state.models[0]));
    const context = Object.fromEntries(
      Object.entries(held).filter(([, on]) => on.size).map(([layer, on]) => [layer, [...on].sort((a, b) => a - b)]),
    );
    return {
      objects: [],
      ...(withBoard && scene),
      ...(field('room').value && { room_type: field('room').value }),
      model: state.models[state.shown],
      ...(state.unknown !== 'error' && { unknown_labels: state.unknown }),
      seed: Number(field('seed').value),
      temperature: Number(field('temperature').value),
      steps,
      ...(Object.keys(context).length && { context }),
    };
  }

  /** Ends a drawing that runs: what has come of it stays. */
  function quit() {
    stop();
    controller.abort();
    busy(false);
  }

  function busy(on) {
    if (on) drawn.setAttribute('aria-busy', 'true');
    else drawn.removeAttribute('aria-busy');
    document.getElementById('quit').hidden = !on;
  }

  async function draw() {
    quit();
    controller = new AbortController();
    const { signal } = controller;
    const state = store.get();
    frames = [];
    busy(true);
    let body = null;
    try {
      for (const steps of SWEEPS) {
        body = bodyOf(state, steps);
        const answer = await call('generate', body, signal);
        if (signal.aborted) return;
        frames.push({ steps, body, scene: answer.scenes[0], board: field('evidence').checked ? state.things : [] });
        shown.problem.hidden = true;
        shown.range.max = frames.length - 1;
        frame(frames.length - 1);
      }
      const { scene } = frames.at(-1);
      say(`Drawn: ${scene.objects.length} objects after ${SWEEPS.at(-1)} sweeps. ${scene.objects.join(', ')}.`);
    } catch (error) {
      if (!signal.aborted) fail(error, body);
    } finally {
      if (!signal.aborted) busy(false);
    }
  }

  function fail(error, body) {
    if (error instanceof UnreachableError) store.set({ down: true });
    else if (!(error instanceof ProblemError)) throw error;
    shown.problem.hidden = false;
    shown.problem.replaceChildren(...(error.problem ? problemWords(error.problem, body) : [error.message]));
  }

  function frame(index) {
    const { steps, body, scene, board } = frames[index];
    shown.node.hidden = false;
    shown.range.value = index;
    shown.words.textContent = `${steps} of ${SWEEPS.at(-1)}`;
    shown.range.setAttribute('aria-valuetext', `after ${steps} sweeps`);
    const before = new Set(frames[index - 1]?.scene.objects ?? scene.objects);
    const now = new Set(scene.objects);
    const came = scene.objects.filter((label) => !before.has(label));
    const went = [...before].filter((label) => !now.has(label));
    const known = contextsOf(store.get()) ?? {};
    const active = Object.entries(scene.context).flatMap(([layer, on]) =>
      on.map((unit) => known[layer]?.[unit]).filter(Boolean));
    shown.detail.replaceChildren(
      el('p', {}, el('b', {}, `${scene.objects.length} objects`), `, log score ${scene.log_score.toFixed(1)}`),
      el('ul', { class: 'chips' }, ...scene.objects.map((label) => el('li', { class: came.includes(label) ? 'came' : '' }, label)),
        ...went.map((label) => el('li', { class: 'went' }, el('s', {}, label)))),
      el('details', {}, el('summary', {}, `${scene.relations.length} relations, ${active.length} contexts on`),
        el('ul', {}, ...scene.relations.map((one) => el('li', {}, `${one.subject} ${SPOKEN[one.relation]} ${one.object}`))),
        el('ul', { class: 'chips' }, ...active.map((unit) => el('li', {}, nameOf(unit))))));
    shown.calls.show('generate', body);
    store.set({ draft: draftOf(store.get(), scene, board), selected: null });
  }

  /** The drawn scene on the board: what was there stays, the rest is laid out by its relations. */
  function draftOf(state, scene, board) {
    const sized = sizer(sizesOf(state, state.models[0]));
    const canonical = state.words[state.models[state.shown]]?.canonical ?? ((label) => label);
    const ids = new Map(board.map((thing) => [canonical(thing.label), thing.id]).reverse());
    const before = new Map((state.draft?.things ?? []).map((thing) => [thing.id, thing]));
    const things = [...board];
    for (const label of scene.objects) {
      if (ids.has(label)) continue;
      const id = freshId(things, label);
      ids.set(label, id);
      things.push({ id, label, size: null, yaw: 0, confidence: 1, z: 0 });
    }
    const fresh = new Set(things.slice(board.length).map((thing) => thing.id));
    const relations = scene.relations.map((one) => ({
      relation: one.relation, subject: ids.get(one.subject), object: ids.get(one.object),
    }));
    const free = things.slice(board.length).map((thing) => ({
      ...sized(thing), x: before.get(thing.id)?.x, y: before.get(thing.id)?.y,
    }));
    const placed = layOut(board.map(sized), free, relations, state.viewer);
    return { things: [...board, ...placed.map((box) => ({ ...box, size: null }))], fresh, relations, room: field('room').value };
  }

  function play() {
    shown.play.textContent = 'Stop';
    let index = Number(shown.range.value) >= frames.length - 1 ? 0 : Number(shown.range.value) + 1;
    const next = () => {
      frame(index);
      index += 1;
      if (index < frames.length) timer = setTimeout(next, PACE);
      else stop();
    };
    next();
  }

  function stop() {
    clearTimeout(timer);
    timer = 0;
    shown.play.textContent = 'Play';
  }

  function listUnits(state) {
    const known = contextsOf(state) ?? {};
    const wanted = find.value.trim().toLowerCase();
    const all = Object.entries(known).flatMap(([layer, list]) => list.map((unit) => ({ layer, ...unit })));
    const on = ({ layer, unit }) => held[layer]?.has(unit) ?? false;
    const fits = ({ objects, room_types: rooms }) =>
      !wanted || [...objects.slice(0, 5), ...rooms.slice(0, 2)].some(({ label }) => label.includes(wanted));
    const listed = [...all.filter(on), ...all.filter((unit) => !on(unit) && fits(unit))].slice(0, UNITS);
    redraw(units, listed.map((unit) => {
      const input = el('input', { type: 'checkbox', 'data-key': `${unit.layer}/${unit.unit}`, onchange: () => hold(unit, input.checked) });
      input.checked = on(unit);
      return el('label', {}, input, el('span', {}, nameOf(unit), el('span', { class: 'quiet' }, ` ${unit.layer} ${unit.unit}`)));
    }));
    const count = Object.values(held).reduce((sum, set) => sum + set.size, 0);
    document.getElementById('held').textContent = count ? `(${count})` : '';
  }

  function hold({ layer, unit }, on) {
    held[layer] ??= new Set();
    if (on) held[layer].add(unit);
    else held[layer].delete(unit);
    listUnits(store.get());
  }

  form.addEventListener('submit', (event) => {
    event.preventDefault();
    void draw();
  });
  document.getElementById('another').addEventListener('click', () => {
    field('seed').value = Number(field('seed').value) + 1;
    void draw();
  });
  find.addEventListener('input', () => listUnits(store.get()));
  document.getElementById('keep').addEventListener('click', () => {
    const { things, room } = store.get().draft;
    if (things.length > MOST_OBJECTS) {
      store.set({ complaint: FULL });
      return;
    }
    quit();
    store.edit({ things, room: room || store.get().room, draft: null, tab: 'missing' });
    say(`The drawn scene is on the board: ${things.length} objects.`);
  });
  document.getElementById('quit').addEventListener('click', () => {
    quit();
    form.querySelector('.primary').focus();
    say('Stopped.');
  });
  document.getElementById('discard').addEventListener('click', () => {
    quit();
    store.set({ draft: null });
  });

  return (state, previous) => {
    if (changed(state, previous, 'contexts', 'models', 'shown')) {
      if (changed(state, previous, 'models', 'shown')) held = {};
      listUnits(state);
    }
    if (state.tab !== previous.tab && state.tab !== 'generate') {
      quit();
      if (state.draft) store.set({ draft: null });
    }
    if (changed(state, previous, 'draft')) {
      document.getElementById('draft').hidden = !state.draft;
      document.getElementById('draft-words').textContent = state.draft
        ? `Drawn by the model: ${state.draft.things.length} objects, laid out by their relations.` : '';
    }
  };
}
