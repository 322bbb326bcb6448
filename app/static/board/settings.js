/** The controls of the scene and of the questions. */

import { el } from './dom.js';
import { wrongIn } from './edges.js';
import { readings } from './questions.js';
import { changed } from './store.js';
import { SPOKEN } from './words.js';

const get = (id) => document.getElementById(id);

/** The symbols of the board for each question. The edges of a generated scene are those of the selected object. */
const SYMBOLS = {
  missing: [['ghost', 'suggestion: click to add it']],
  outliers: [['misplaced', 'relation that is probably wrong']],
  relations: [['holds', 'expected and observed'], ['expected', 'expected'], ['disagrees', 'expected instead of the observed relation']],
  generate: [['fresh', 'generated'], ['drawn', 'relation of the selected object']],
};

function legend({ tab, draft, posed, at, selected }) {
  return [
    ['robot', 'robot and the direction it looks in'],
    ...(draft || !selected ? [] : [['selected', 'selected']]),
    ...(draft ? [] : [['outlier', 'does not belong']]),
    ...(posed && !draft ? [['loose', 'position not given']] : []),
    ...(at ? [['anchor', 'place of the question']] : []),
    ...SYMBOLS[tab],
  ];
}

/** What counts as evidence, in words. */
function evidence({ posed, things, relations }) {
  const given = things.filter(({ placed }) => placed).length;
  if (posed) {
    const rest = given < things.length ? ` Move an object to give its position.` : '';
    return `The answers use the positions of ${given} of ${things.length} objects.${rest}`;
  }
  const stated = relations.length ? ` and ${relations.length} stated ${relations.length === 1 ? 'relation' : 'relations'}` : '';
  return `The answers use labels${stated} only. Moving an object changes the picture, not the answers.`;
}

export function settings(store) {
  get('sensitivity').addEventListener('change', ({ target }) => store.set({ sensitivity: target.value }));
  get('posed').addEventListener('change', ({ target }) => store.edit({ posed: target.checked }));
  get('room').addEventListener('change', ({ target }) => store.edit({ room: target.value }));
  get('at-off').addEventListener('click', () => {
    store.set({ at: null });
    get('tab-missing').focus();
  });

  function rooms(state) {
    const known = state.words[state.models[0]]?.rooms ?? [];
    const all = state.room && !known.includes(state.room) ? [...known, state.room] : known;
    get('room').replaceChildren(el('option', { value: '' }, 'unknown'), ...all.map((room) => el('option', { value: room }, room)));
    get('room').value = state.room;
    get('room').parentElement.hidden = !all.length;
  }

  function draw(state, previous) {
    get('sensitivity').value = state.sensitivity;
    get('posed').checked = state.posed;
    get('evidence').textContent = evidence(state);
    get('search-error').textContent = state.complaint;
    get('room-error').textContent = readings(state, 'rooms', state.room);
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
    }
    get('legend').replaceChildren(...legend(state).map(([kind, words]) => el('span', { class: kind }, words)));
  }

  draw(store.get(), {});
  return draw;
}
