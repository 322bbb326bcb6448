/** Connects the parts of the page. */

import { createActions } from './actions.js';
import { useKey, UnreachableError } from './api.js';
import { startAsking } from './asking.js';
import { createBoard } from './board.js';
import { createColumns } from './columns.js';
import { combobox } from './combobox.js';
import { el } from './dom.js';
import { EXAMPLES } from './examples.js';
import { fileDialog } from './file.js';
import { createGeneration } from './generation.js';
import { accept } from './ghosts.js';
import { layOut } from './layout.js';
import { createList } from './list.js';
import { createModels } from './models.js';
import { createProperties } from './properties.js';
import { sizesOf } from './questions.js';
import { watchService } from './recovery.js';
import { fromScene, SceneError, sizer } from './scene.js';
import { settings } from './settings.js';
import { fromHash } from './share.js';
import { createStore } from './store.js';
import { summary } from './summary.js';
import { tabs } from './tabs.js';
import { theme } from './theme.js';

const get = (id) => document.getElementById(id);
const say = (words) => (get('live').textContent = words);

const store = createStore({
  things: [], viewer: { x: 0, y: 0, yaw: 0 }, room: '', models: ['default', ''], shown: 0, tab: 'missing',
  selected: null, snap: true, at: null, suggestions: 5, coverage: null, sensitivity: 'medium', threshold: null, least: 0.25, most: 12, own: false,
  observed: false, unknown: 'error', answers: [{}, {}], draft: null, words: {}, contexts: {}, down: false,
  complaint: '', epoch: 0, canUndo: false,
});

/**
 * Puts a scene of the API on the board.
 * @returns {string} a note about ignored relations, or ''
 * @throws {SceneError}
 */
function put(scene) {
  const sizes = sizesOf(store.get(), store.get().models[0]);
  const { things, viewer, room, relations } = fromScene(scene, sizes);
  const sized = sizer(sizes);
  const loose = things.filter((thing) => !thing.placed).map((thing) => ({ ...sized(thing), x: undefined, y: undefined }));
  const fixed = things.filter((thing) => thing.placed).map(sized);
  const places = new Map(layOut(fixed, loose, relations, viewer).map((box) => [box.id, box]));
  store.edit({
    things: things.map(({ placed, ...thing }) => {
      const { x, y, z } = placed ? thing : places.get(thing.id);
      return { ...thing, x, y, z };
    }),
    viewer, room, selected: null, at: null, draft: null,
  });
  const unplaced = new Set(loose.map((thing) => thing.id));
  const unused = relations.filter((one) => !unplaced.has(one.subject) && !unplaced.has(one.object)).length;
  const words = unused
    ? `${unused} ${unused === 1 ? 'relation was' : 'relations were'} ignored: requests of the board contain positions only.` : '';
  get('note').textContent = words;
  get('note').hidden = !words;
  return words;
}

function tell(error) {
  if (error instanceof UnreachableError) {
    store.set({ down: true });
  } else {
    get('banner').replaceChildren(el('b', {}, error.message), ` ${error.problem?.detail ?? ''} `,
      ...(error.problem?.status === 401 ? [askKey()] : []));
    get('banner').hidden = false;
  }
}

/** A form for the API key of the service. */
function askKey() {
  const input = el('input', { type: 'password', autocomplete: 'off', 'aria-label': 'API key' });
  return el('form', {
    class: 'row',
    onsubmit: (event) => {
      event.preventDefault();
      useKey(input.value);
      get('banner').hidden = true;
      void models.load();
      store.set({ epoch: store.get().epoch + 1 });
    },
  }, el('label', {}, 'API key ', input), el('button', {}, 'Use it'));
}

const actions = createActions(store, say, get('menu'));
const takeGhost = (ghost) => {
  const id = accept(store, ghost);
  if (!id) return;
  say(`${id} is on the board.`);
  requestAnimationFrame(() => board.focus(id));
};
const board = createBoard(get('board'), store, actions, takeGhost);
const models = createModels(store, get('model'), get('second'), tell);
const views = [
  board.render,
  createList(get('list'), get('empty'), get('count'), actions),
  createProperties(get('properties'), store, actions, say),
  createColumns(store, (question) => document.querySelector(`.columns[data-question=${question}]`), askKey),
  createGeneration(get('generate'), get('drawn'), store, say),
  tabs(document.querySelector('[role=tablist]'), store),
  settings(store),
];

// Views draw at most once per frame, even if the state changes more often.
let drawn = null;
store.subscribe((state, previous) => {
  if (drawn) return;
  drawn = previous;
  requestAnimationFrame(() => {
    const before = drawn;
    drawn = null;
    for (const view of views) view(store.get(), before);
  });
});

let said = '';
store.subscribe((state, previous) => {
  if (state.answers === previous.answers) return;
  const words = summary(state);
  if (words && words !== said) say((said = words));
});

combobox(get('search'), get('found'), () => store.get().words[store.get().models[0]]?.objects ?? [],
  (label) => actions.add(label), (words) => store.set({ complaint: words }));
fileDialog(store, put, say);
theme(get('theme'));
watchService(store, get('banner'), () => void models.load());

for (const name of Object.keys(EXAMPLES)) get('example').append(el('option', { value: name }, name));
get('example').addEventListener('change', ({ target }) => {
  if (target.value) put(EXAMPLES[target.value]);
  target.value = '';
});
get('undo').addEventListener('click', () => store.undo());
get('clear').addEventListener('click', () => {
  get('note').hidden = true;
  store.edit({ things: [], selected: null, at: null, draft: null });
});
document.addEventListener('keydown', (event) => {
  const typing = event.target.closest('input, textarea, select');
  if ((event.ctrlKey || event.metaKey) && event.key === 'z' && !typing) {
    event.preventDefault();
    store.undo();
  }
});

async function open() {
  try {
    const scene = await fromHash(location.hash);
    if (scene) put(scene);
    return Boolean(scene);
  } catch (error) {
    get('banner').textContent = `The scene in this link cannot be read${error instanceof SceneError ? `: ${error.message}` : '.'}`;
    get('banner').hidden = false;
    return false;
  }
}

addEventListener('hashchange', () => void open());
// The vocabulary has the typical sizes, which the layout of scenes without positions needs.
await models.load();
if (!(await open())) put(Object.values(EXAMPLES)[0]);
store.set({ canUndo: false });
startAsking(store);
document.querySelector('main').removeAttribute('aria-busy');
