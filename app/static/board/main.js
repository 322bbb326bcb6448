/** Connects the parts of the page. */

import { createAbout } from './about.js';
import { createActions } from './actions.js';
import { useKey, UnreachableError } from './api.js';
import { startAsking } from './asking.js';
import { createBoard } from './board.js';
import { createColumns } from './columns.js';
import { combobox } from './combobox.js';
import { el } from './dom.js';
import { fileDialog } from './file.js';
import { createGeneration } from './generation.js';
import { accept } from './ghosts.js';
import { layOut } from './layout.js';
import { createList } from './list.js';
import { createModels } from './models.js';
import { createProperties } from './properties.js';
import { createNotes } from './notes.js';
import { hangingOf, sizesOf } from './questions.js';
import { watchService } from './recovery.js';
import { fromScene, SceneError, sizer } from './scene.js';
import { createRecords, newLine, withSources } from './records.js';
import { settings } from './settings.js';
import { fromHash } from './share.js';
import { openAlarms } from './edges.js';
import { createSender } from './confirming.js';
import { changed, createStore } from './store.js';
import { summary } from './summary.js';
import { tabs } from './tabs.js';
import { createRecorded } from './recorded.js';
import { createVerdicts, isJudged, statusOf } from './verdicts.js';
import { createWhere, roomsOf } from './where.js';
import { nowhere } from './spots.js';

const get = (id) => document.getElementById(id);
const say = (words) => (get('live').textContent = words);

const store = createStore({
  things: [], relations: [], posed: false, viewer: { x: 0, y: 0, yaw: 0 }, room: '', models: ['default', ''], shown: 0,
  tab: 'missing', selected: null, at: null, sensitivity: 'medium', answers: [{}, {}], draft: null, words: {},
  down: false, complaint: '', epoch: 0, canUndo: false,
  line: newLine(), right: [], covered: new Map(), where: nowhere(),
});

const OPENING = 4; // labels that the board shows for a model without examples

/**
 * Puts a scene of the API on the board, with its line if it comes from a file of recorded scenes. Objects without a position are laid out by their relations.
 * @throws {SceneError}
 */
function put(scene, change = {}, line = newLine()) {
  const sizes = sizesOf(store.get(), store.get().models[0]);
  const { things, viewer, room, relations, foreign } = fromScene(scene, sizes);
  const boxes = things.map(sizer(sizes));
  const [fixed, free] = [boxes.filter(({ placed }) => placed), boxes.filter(({ placed }) => !placed)];
  const hanging = hangingOf(store.get(), store.get().models[0]);
  const places = new Map(layOut(fixed, free, relations, viewer, hanging).map((box) => [box.id, box]));
  store.edit({
    things: withSources(things.map((thing) => {
      const { x, y, z } = places.get(thing.id) ?? thing;
      return { ...thing, x, y, z };
    }), line),
    line, right: [],
    // As in the service, stated relations take precedence over positions.
    relations, posed: !relations.length && things.some(({ placed }) => placed),
    viewer, room, selected: null, at: null, draft: null, ...change,
  });
  note(foreign);
  showNotes([]);
}

function note(words) {
  get('note').textContent = words;
  get('note').hidden = !words;
}

/** Opens with the first example of the model, or with some of its labels. Positions of examples do not count. */
function openModel() {
  const { examples = [], proposed = [] } = store.get().words[store.get().models[0]] ?? {};
  if (examples.length) {
    put(examples[0].scene, { posed: false });
  } else if (proposed.length) {
    put({ objects: proposed.slice(0, OPENING) });
    note('This model has no example scenes. The board shows its first labels: replace them by your own objects.');
  }
}

/** Loads the models after a failure. A board that is still untouched opens with a scene. */
async function reload() {
  await models.load();
  const { things, canUndo } = store.get();
  if (things.length || canUndo) return;
  openModel();
  store.set({ canUndo: false });
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
      void reload();
      store.set({ epoch: store.get().epoch + 1 });
    },
  }, el('label', {}, 'API key ', input), el('button', {}, 'Use it'));
}

const showNotes = createNotes(get('file-notes'), get('open-file'));
const actions = createActions(store, say, get('menu'), (id) => where.menuOf(id));
const takeGhost = (ghost) => {
  const id = accept(store, ghost);
  if (!id) return;
  say(`${id} is on the board.`);
  requestAnimationFrame(() => board.focus(id));
};
const board = createBoard(get('board'), store, actions, takeGhost);
const models = createModels(store, get('model'), get('second'), tell, (words) => {
  get('news').replaceChildren(words, ' ', el('button', { type: 'button', onclick: dismiss }, 'Dismiss'));
  get('news').hidden = false;
});
function dismiss() {
  get('news').hidden = true;
  get('model').focus();
}
get('model').addEventListener('change', () => (get('news').hidden = true));
get('second').addEventListener('change', () => (get('news').hidden = true));
const verdicts = createVerdicts(store, say, actions.add);
get('confirm-scene').addEventListener('click', verdicts.sceneIsRight);
const where = createWhere(get('panel-where'), store, say, (index) => file.place(index));
const views = [
  board.render,
  createProperties(get('properties'), store, actions), // leaves less room for the list
  createList(get('list'), get('empty'), get('count'), actions),
  createColumns(store, (question) => document.querySelector(`.columns[data-question=${question}]`), askKey,
    verdicts),
  createGeneration(get('generate'), get('drawn'), store, say),
  tabs(document.querySelector('[role=tablist]'), store),
  where.render,
  settings(store),
  createAbout(store, get('about')),
  listExamples,
  (state, previous) => changed(state, previous, 'line', 'things', 'right', 'answers', 'shown', 'covered') && showRecords(),
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
  (label) => actions.add(label));
const sender = createSender(store, showRecords);
const records = createRecords(store, showRecords, sender);
const recorded = createRecorded(store, records, (index) => file.place(index));
const file = fileDialog(store, records, recorded, (scene, notes, line) => {
  put(scene, {}, line);
  showNotes(notes);
  if (!store.get().down) get('banner').hidden = true; // such as that of a broken link
}, say, (scenes, index, isNew) => {
  if (isNew) where.useRooms(roomsOf(scenes, records));
  where.placed(index);
});
watchService(store, get('banner'), () => void reload());

/** Says whether the scene is confirmed, and how many confirmed scenes can be downloaded. */
function showRecords() {
  const state = store.get();
  const isConfirmed = Boolean(state.line.confirmed);
  const open = openAlarms(state);
  get('confirmed').hidden = !isConfirmed && !isJudged(state) && !sender.words(state.line);
  get('recorded').hidden = !state.line.objects && (isConfirmed || !isJudged(state));
  get('confirm-scene').hidden = isConfirmed;
  get('confirm-scene').textContent = `This scene is right${open ? ` (${open} false ${open === 1 ? 'alarm' : 'alarms'})` : ''}`;
  get('confirmed').textContent = isConfirmed
    ? `Confirmed scene. ${sender.words(state.line) || `Import, export downloads the file (${records.count()} confirmed).`}`
    : [isJudged(state) ? statusOf(state) : '', sender.words(state.line)].filter(Boolean).join(' ');
  recorded.draw();
}

/** Lists the examples of the first model. */
function listExamples(state, previous) {
  if (!changed(state, previous, 'words', 'models')) return;
  const { examples = [] } = state.words[state.models[0]] ?? {};
  get('example').replaceChildren(el('option', { value: '' }, 'Examples…'),
    ...examples.map(({ name }, index) => el('option', { value: index }, name)));
  get('example').hidden = !examples.length;
}
get('example').addEventListener('change', ({ target }) => {
  put(store.get().words[store.get().models[0]].examples[target.value].scene, { posed: false });
  target.value = '';
});
function undo() {
  if (!store.get().canUndo) return;
  store.undo();
  say('The last change is undone.');
}
get('undo').addEventListener('click', undo);
get('clear').addEventListener('click', () => {
  note('');
  showNotes([]);
  store.edit({ things: [], relations: [], room: '', selected: null, at: null, draft: null, line: newLine(), right: [] });
});
document.addEventListener('keydown', (event) => {
  const typing = event.target.closest('input, textarea, select');
  if ((event.ctrlKey || event.metaKey) && event.key === 'z' && !typing) {
    event.preventDefault();
    undo();
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
if (!(await open())) openModel();
store.set({ canUndo: false });
startAsking(store);
document.querySelector('main').removeAttribute('aria-busy');
