/** The controls that say what is asked and what is shown. */

import { el } from './dom.js';
import { wrongIn } from './edges.js';
import { complaints } from './list.js';
import { changed } from './store.js';
import { percent, SPOKEN } from './words.js';

const get = (id) => document.getElementById(id);

/** Controls by the part of the state that they set; `read` and `write` turn one into the other. */
const SLIDERS = [
  { id: 'suggestions', words: (value) => String(value), read: Number, write: (value) => value },
  { id: 'least', words: percent, read: (value) => Number(value) / 100, write: (value) => 100 * value },
  { id: 'most', words: (value) => String(value), read: Number, write: (value) => value },
  {
    id: 'coverage', read: (value) => Number(value) / 100, write: (value) => 100 * (value ?? 0.5),
    words: (value) => (value === null ? 'model’s own' : percent(value)),
  },
  {
    id: 'threshold', read: (value) => Number(value) / 100, write: (value) => 100 * (value ?? 0.5),
    words: (value) => (value === null ? 'model’s own' : percent(value)),
  },
];
const SWITCHES = ['snap', 'own', 'observed'];
const CHOICES = ['sensitivity', 'unknown'];
/** Settings of which the model has its own. */
const OWN = ['coverage', 'threshold'];

const LEGENDS = {
  missing: [['ghost', 'suggested: click to put it there'], ['spread', 'four of five stand within']],
  outliers: [['against', 'speaks against it'], ['misplaced', 'in the wrong place']],
  relations: [['holds', 'expected, and so it is'], ['expected', 'expected'], ['disagrees', 'expected otherwise']],
  generate: [['fresh', 'drawn by the model']],
};

export function settings(store) {
  for (const { id, read } of SLIDERS) {
    get(id).addEventListener('input', ({ target }) => store.set({ [id]: read(target.value) }));
  }
  for (const id of SWITCHES) {
    get(id).addEventListener('change', ({ target }) => store.set({ [id]: target.checked }));
  }
  for (const id of CHOICES) {
    get(id).addEventListener('change', ({ target }) => store.set({ [id]: target.value }));
  }
  for (const id of OWN) {
    get(`${id}-off`).addEventListener('click', () => store.set({ [id]: null }));
  }
  get('at-off').addEventListener('click', () => {
    store.set({ at: null });
    get('tab-missing').focus();
  });
  get('room').addEventListener('change', ({ target }) => store.edit({ room: target.value }));

  function rooms(state) {
    const known = state.words[state.models[0]]?.rooms ?? [];
    const all = state.room && !known.includes(state.room) ? [...known, state.room] : known;
    const options = () => all.map((room) => el('option', { value: room }, room));
    get('room').replaceChildren(el('option', { value: '' }, 'not said'), ...options());
    get('room').value = state.room;
    const wish = get('generate').elements.namedItem('room');
    const chosen = wish.value;
    wish.replaceChildren(el('option', { value: '' }, 'any'), ...options());
    wish.value = chosen || state.room;
  }

  function draw(state, previous) {
    for (const { id, words, write } of SLIDERS) {
      const slider = get(id);
      slider.value = write(state[id]);
      slider.nextElementSibling.textContent = words(state[id]);
      slider.setAttribute('aria-valuetext', words(state[id]));
    }
    for (const id of SWITCHES) get(id).checked = state[id];
    for (const id of CHOICES) get(id).value = state[id];
    for (const id of OWN) get(`${id}-off`).disabled = state[id] === null;
    get('search-error').textContent = state.complaint;
    get('undo').disabled = !state.canUndo;
    document.body.classList.toggle('two', Boolean(state.models[1]));
    get('at').hidden = !state.at;
    if (state.at) get('at-words').textContent = `Missing ${SPOKEN[state.at.relation]} ${state.at.object}`;
    if (changed(state, previous, 'words', 'models', 'room')) rooms(state);
    if (changed(state, previous, 'answers', 'shown')) {
      const answer = state.answers[state.shown].outliers?.answer;
      const { outliers, misplaced } = answer ? wrongIn(answer) : { outliers: [], misplaced: [] };
      get('alarms').textContent = outliers.length + misplaced.length;
      get('alarms').hidden = get('alarms').textContent === '0';
      get('room-error').textContent = complaints(state)
        .filter(({ error }) => error.pointer === '#/room_type').map(({ words }) => words).join(' ');
    }
    get('legend').replaceChildren(...LEGENDS[state.tab].map(([kind, words]) =>
      el('span', { class: kind }, words)));
  }

  const form = get('generate').elements;
  form.namedItem('seed').value = 7;
  form.namedItem('temperature').value = 1;
  draw(store.get(), {});
  return draw;
}
