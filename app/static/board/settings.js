/** The controls of the scene and of the questions. */

import { outliersOf } from './board.js';
import { el } from './dom.js';
import { edgesOf, isDoubtful, judgedBy, wrongIn } from './edges.js';
import { UNKNOWN_SIZE } from './geometry.js';
import { ghostsOf } from './ghosts.js';
import { inWords, isCertain, leftOut, mappedBy, readings, sizesOf } from './questions.js';
import { sizer } from './scene.js';
import { searchedOf, spotsOf } from './spots.js';
import { changed } from './store.js';
import { namesOf, percent, plain, shown, SPOKEN } from './words.js';

const get = (id) => document.getElementById(id);

/** The symbols of the board in words; the legend lists those that are visible. */
const SYMBOLS = {
  robot: 'robot and the direction it looks in', selected: 'selected', outlier: 'does not belong', doubtful: 'probably a wrong detection', spot: 'possible place of the thing', searched: '✓ searched',
  unknown: 'not known to the model, left out', guess: 'size not known', loose: 'position not given', anchor: 'place of the question', ghost: 'suggestion: click to add it',
  misplaced: 'probably in the wrong place', holds: 'observed', expected: 'expected',
  disagrees: 'expected instead of what is observed', fresh: 'generated', drawn: 'relation',
};

function visible(state) {
  const { draft, posed, at, selected, things } = state;
  const edges = new Set(edgesOf(state).map(({ kind }) => kind));
  const seen = {
    robot: true, selected, outlier: [...outliersOf(state).values()].some((one) => one.is_outlier),
    doubtful: [...outliersOf(state).values()].some(isDoubtful), spot: spotsOf(state).size, searched: searchedOf(state).size,
    unknown: things.some(({ id }) => leftOut(state, state.shown).has(id)),
    guess: [...things.map(sizer(sizesOf(state, state.models[0]))), ...ghostsOf(state)].some(({ size }) => size === UNKNOWN_SIZE),
    loose: posed && things.some(({ placed }) => !placed), anchor: at, ghost: ghostsOf(state).length,
  };
  return Object.keys(SYMBOLS).filter((kind) => edges.has(kind) || (draft ? ['robot', 'fresh'].includes(kind) : seen[kind]));
}

/** What counts as evidence, in words. */
function evidence(state) {
  const { posed, things, relations } = state;
  const left = leftOut(state, state.shown);
  const known = things.filter(({ id }) => !left.has(id));
  const given = known.filter(({ placed }) => placed).length;
  if (posed) {
    const rest = given < known.length ? ' Move an object to give its position.' : '';
    return `The answers use the positions of ${given} of ${things.length} objects.${rest}`;
  }
  const stated = relations.length ? ` and ${relations.length} stated ${relations.length === 1 ? 'relation' : 'relations'}` : '';
  return `The answers use labels${stated} only. Moving an object changes the picture, not the answers.`;
}

const roomsOf = (state) => state.answers?.[state.shown].rooms?.answer;
const roomRead = (state) => state.answers && mappedBy(state, state.shown, state.room)?.class;

export function settings(store) {
  get('sensitivity').addEventListener('change', ({ target }) => store.set({ sensitivity: target.value }));
  get('posed').addEventListener('change', ({ target }) => store.edit({ posed: target.checked }));
  get('room').addEventListener('change', ({ target }) => store.edit({ room: target.value }));
  get('at-off').addEventListener('click', () => {
    store.set({ at: null });
    get('tab-missing').focus();
  });

  /** Lists the room types with their probabilities given the objects, likeliest first. */
  function rooms(state) {
    const known = state.words[state.models[0]]?.rooms ?? [];
    const all = state.room && !known.includes(state.room) ? [...known, state.room] : [...known];
    const answer = roomsOf(state)?.room_types ?? [];
    const likely = new Map(answer.map((one) => [plain(one.room_type), one.probability]));
    const probability = (room) => likely.get(plain(room)) ?? likely.get(plain(mappedBy(state, state.shown, room)?.class ?? ''));
    all.sort((a, b) => (probability(b) ?? 0) - (probability(a) ?? 0));
    const words = (room) => (probability(room) === undefined ? shown(room) : `${shown(room)} ${percent(probability(room))}`);
    get('room').replaceChildren(el('option', { value: '' }, 'unknown'), ...all.map((room) => el('option', { value: room }, words(room))));
    get('room').value = state.room;
    get('room').parentElement.hidden = !all.length;
    const [first] = answer;
    get('room-likely').textContent = first ? `Likeliest: ${first.room_type} ${percent(first.probability)}` : '';
  }

  function draw(state, previous) {
    get('sensitivity').value = state.sensitivity;
    get('posed').checked = state.posed;
    get('evidence').textContent = evidence(state);
    get('search-error').textContent = state.complaint;
    get('room-error').textContent = readings(state, 'rooms', state.room).map(inWords).join('. ');
    get('room-error').classList.toggle('certain', isCertain(state, state.room));
    get('undo').disabled = !state.canUndo;
    document.body.classList.toggle('two', Boolean(state.models[1]));
    get('at').hidden = !state.at;
    if (state.at) get('at-words').textContent = `Missing ${SPOKEN[state.at.relation]} ${namesOf(state.things)(state.at.object)}`;
    if (changed(state, previous, 'words', 'models', 'room', 'shown') || roomsOf(state) !== roomsOf(previous) || roomRead(state) !== roomRead(previous)) rooms(state);
    if (changed(state, previous, 'answers', 'shown', 'draft', 'things', 'right', 'line', 'covered', 'room')) {
      const answer = judgedBy(state.answers[state.shown], state);
      const { outliers, misplaced } = answer ? wrongIn(answer) : { outliers: [], misplaced: [] };
      get('alarms').textContent = outliers.length + misplaced.length;
      get('alarms').hidden = Boolean(state.draft) || get('alarms').textContent === '0';
    }
    get('legend').replaceChildren(...visible(state).map((kind) => el('span', { class: kind }, SYMBOLS[kind])));
  }

  draw(store.get(), {});
  return draw;
}
