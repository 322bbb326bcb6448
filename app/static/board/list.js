/** The objects of the board as a list, for keyboards and screen readers. */

import { whereabouts } from './actions.js';
import { outliersOf } from './board.js';
import { el } from './dom.js';
import { changed } from './store.js';

const SEEN = ['things', 'selected', 'answers', 'shown', 'viewer', 'draft'];

export function createList(list, empty, count, actions) {
  function row(thing) {
    const { id } = thing;
    const name = el('button', {
      type: 'button', class: 'name', 'aria-describedby': 'board-help',
      onclick: () => actions.select(id),
      onkeydown: (event) => actions.keys(event, id),
      oncontextmenu: (event) => {
        event.preventDefault();
        actions.open(id, event.currentTarget, { left: event.clientX, top: event.clientY });
      },
    }, el('b', {}, id), el('span', { class: 'quiet' }));
    const more = el('button', {
      type: 'button', class: 'icon', 'aria-haspopup': 'menu', 'aria-label': `Actions for ${id}`,
      onclick: (event) => actions.open(id, event.currentTarget),
    }, '⋯');
    const remove = el('button', {
      type: 'button', class: 'icon', 'aria-label': `Remove ${id}`, onclick: () => actions.remove(id),
    }, '✕');
    return el('li', {}, name, more, remove, el('p', { class: 'error' }));
  }

  function draw(state) {
    const wrong = outliersOf(state);
    const errors = errorsByObject(state);
    const rows = d3.select(list).selectAll('li').data(state.things, (thing) => thing.id)
      .join((enter) => enter.append(row));
    rows.each(function update(thing, index) {
      const out = wrong.get(thing.id)?.is_outlier;
      const chosen = thing.id === state.selected;
      this.classList.toggle('selected', chosen);
      this.querySelector('.name').setAttribute('aria-current', String(chosen));
      const words = [
        thing.id === thing.label ? null : thing.label, whereabouts(thing.x, thing.y, state.viewer),
        out ? 'does not belong here' : null,
      ];
      this.querySelector('.name span').textContent = words.filter(Boolean).join(' · ');
      this.classList.toggle('outlier', Boolean(out));
      this.querySelector('.error').textContent = errors.get(index) ?? '';
    });
    empty.hidden = state.things.length > 0;
    count.textContent = state.things.length ? `(${state.things.length})` : '';
  }

  return (state, previous) => changed(state, previous, ...SEEN) && draw(state);
}

/** The error messages of the service, by index of the object. */
function errorsByObject(state) {
  const found = new Map();
  for (const { error, words } of complaints(state)) {
    const place = placeOf(error);
    if (place !== null) found.set(place, [found.get(place), words].filter(Boolean).join(' '));
  }
  return found;
}

/** The error messages of all answers; with two models, each begins with the name of its model. */
export function complaints(state) {
  return state.answers.flatMap((own, column) =>
    (own.missing?.problem?.errors ?? []).map((error) => ({
      error, words: state.models[1] ? `${state.models[column]}: ${complaint(error)}.` : complaint(error),
    })));
}

/** The index of the object of an error, or null. */
export function placeOf({ pointer }) {
  const place = /^#\/objects\/(\d+)/.exec(pointer);
  return place ? Number(place[1]) : null;
}

export function complaint({ message, suggestions = [] }) {
  return suggestions.length ? `${message} (${suggestions.join(', ')}?)` : message;
}
