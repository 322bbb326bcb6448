/** The objects of the board as a list, for keyboards and screen readers. */

import { whereabouts } from './actions.js';
import { outliersOf } from './board.js';
import { el, redraw } from './dom.js';
import { isDoubtful } from './edges.js';
import { isCertain, readings } from './questions.js';
import { changed } from './store.js';
import { nameOf, resolvedWords, shown } from './words.js';

const SEEN = ['things', 'selected', 'answers', 'shown', 'viewer', 'draft', 'models', 'posed', 'line', 'covered', 'room', 'right'];

export function createList(list, empty, count, actions) {
  function row({ id }) {
    const name = el('button', {
      type: 'button', class: 'name', 'aria-describedby': 'board-help',
      onclick: () => actions.select(id),
      onkeydown: (event) => actions.keys(event, id),
      oncontextmenu: (event) => {
        event.preventDefault();
        actions.open(id, event.currentTarget, { left: event.clientX, top: event.clientY });
      },
    }, el('b'), el('span', { class: 'quiet' }));
    const more = el('button', {
      type: 'button', class: 'icon', 'aria-haspopup': 'menu',
      onclick: (event) => actions.open(id, event.currentTarget),
    }, '⋯');
    const remove = el('button', {
      type: 'button', class: 'icon', onclick: () => actions.remove(id),
    }, '✕');
    return el('li', {}, name, more, remove, el('div', { class: 'error' }));
  }

  /** What the list says about an object besides its name. */
  function about(thing, state, found) {
    const where = !state.posed || state.draft ? null
      : thing.placed ? whereabouts(thing.x, thing.y, state.viewer) : 'position not given';
    const wrong = found?.is_outlier ? 'does not belong here' : isDoubtful(found) ? 'probably a wrong detection' : null;
    return [where, wrong].filter(Boolean).join(' · ');
  }

  /** How a model reads an unknown label. Each similar label is a button that renames the object. */
  const suggested = ({ id, label }, [words, ...names]) => el('p', {}, words, ...names.flatMap((name) => [' ', el('button', {
    type: 'button', class: 'link', 'data-key': name, 'aria-label': `Rename ${shown(label)} to ${name}`,
    onclick: () => actions.rename(id, name),
  }, `${name}?`)]));

  /** The labels of an object with alternatives, and the first one if it is another label. */
  function decided({ id, label }, state) {
    const found = state.answers[state.shown].outliers?.answer?.resolved?.find((one) => one.object === id);
    if (!found) return [];
    const [first] = found.labels;
    return [[`labels: ${resolvedWords(found)}`, ...(first && first.label !== label ? [first.label] : [])]];
  }

  function draw(state) {
    const wrong = outliersOf(state);
    const things = state.draft?.things ?? state.things;
    list.classList.toggle('draft', Boolean(state.draft));
    const rows = d3.select(list).selectAll('li').data(things, (thing) => thing.id)
      .join((enter) => enter.append(row));
    rows.each(function update(thing) {
      const found = state.draft ? undefined : wrong.get(thing.id);
      const out = Boolean(found?.is_outlier);
      const chosen = thing.id === state.selected;
      this.classList.toggle('selected', chosen);
      this.classList.toggle('outlier', out);
      this.querySelector('.name').setAttribute('aria-current', String(chosen));
      const [, more, remove] = this.querySelectorAll('button');
      more.setAttribute('aria-label', `Actions for ${nameOf(thing)}`);
      remove.setAttribute('aria-label', `Remove ${nameOf(thing)}`);
      this.querySelector('.name b').textContent = nameOf(thing);
      this.querySelector('.name span').textContent = about(thing, state, found);
      this.querySelector('.error').classList.toggle('certain', isCertain(state, thing.label) || Boolean(thing.alternatives));
      const notes = state.draft ? [] : [...readings(state, 'objects', thing.label), ...decided(thing, state)];
      redraw(this.querySelector('.error'), notes.map((one) => suggested(thing, one)));
    });
    empty.hidden = things.length > 0;
    count.textContent = things.length ? `(${things.length}${state.draft ? `, ${state.draft.fresh.size} new` : ''})` : '';
  }

  /** Scrolls the list, but not the page, to the selected object. */
  function reveal() {
    const [row, view] = [list.querySelector('.selected'), list].map((node) => node?.getBoundingClientRect());
    if (row) list.scrollTop += Math.min(0, row.top - view.top) + Math.max(0, row.bottom - view.bottom);
  }

  return (state, previous) => {
    if (changed(state, previous, ...SEEN)) draw(state);
    if (changed(state, previous, 'selected')) reveal();
  };
}
