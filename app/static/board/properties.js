/** The form with the name, pose and size of the selected object. */

import { round } from './geometry.js';
import { sizesOf } from './questions.js';
import { changed } from './store.js';

export function createProperties(form, store, actions, say) {
  const field = (name) => form.elements.namedItem(name);
  const title = form.querySelector('h3');
  const error = document.getElementById('properties-error');
  const source = document.getElementById('size-source');

  function read(input, thing) {
    const { name, value } = input;
    if (name === 'id') return rename(value.trim(), thing);
    const number = Number(value);
    if (!value || !Number.isFinite(number) || !input.checkValidity()) {
      throw new Error(input.validationMessage || 'This must be a number.');
    }
    if (['sx', 'sy', 'sz'].includes(name)) {
      return { size: { ...actions.sized()(thing).size, [name[1]]: number } };
    }
    return { [name]: number };
  }

  function rename(id, thing) {
    if (!id) throw new Error('An object needs a name.');
    if (id !== thing.id && actions.find(id)) throw new Error(`Another object has the name ${id}.`);
    return { id };
  }

  form.addEventListener('submit', (event) => event.preventDefault());
  // A change in one field must not overwrite the text being typed in another field.
  const typing = new Set();
  form.addEventListener('input', ({ target }) => typing.add(target));
  form.addEventListener('focusout', ({ target }) => typing.delete(target));
  form.addEventListener('change', ({ target }) => {
    typing.delete(target);
    const thing = actions.find(store.get().selected);
    if (!thing) return;
    try {
      const change = read(target, thing);
      error.textContent = '';
      target.removeAttribute('aria-invalid');
      if (change.x !== undefined || change.y !== undefined) {
        actions.place(thing.id, change.x ?? thing.x, change.y ?? thing.y, false, true);
      } else {
        actions.change(thing.id, change);
        if (change.id) store.set({ selected: change.id, at: null });
      }
    } catch (problem) {
      error.textContent = problem.message;
      target.setAttribute('aria-invalid', 'true');
    }
  });
  form.addEventListener('click', ({ target }) => {
    const id = store.get().selected;
    if (target.dataset.do === 'menu') actions.open(id, target);
    if (target.dataset.do === 'remove') actions.remove(id);
    if (target.dataset.do === 'typical') {
      actions.change(id, { size: null });
      say(`${id} has its typical size.`);
    }
  });

  function draw(state) {
    const thing = state.things.find(({ id }) => id === state.selected);
    form.hidden = !thing || Boolean(state.draft);
    if (form.hidden) return;
    const { size } = actions.sized()(thing);
    title.textContent = thing.id === thing.label ? thing.id : `${thing.id} (${thing.label})`;
    const known = sizesOf(state, state.models[0]).get(thing.label);
    source.textContent = thing.size ? '' : known ? '(typical)' : '(a guess)';
    const values = { ...thing, sx: size.x, sy: size.y, sz: size.z };
    for (const input of form.querySelectorAll('input')) {
      if (typing.has(input) || (input === document.activeElement && input.getAttribute('aria-invalid'))) continue;
      const value = values[input.name];
      const text = typeof value === 'number' ? String(round(value)) : value;
      if (field(input.name).value !== text) input.value = text;
      input.removeAttribute('aria-invalid');
    }
    form.querySelector('[data-do=typical]').disabled = !thing.size;
  }

  return (state, previous) =>
    changed(state, previous, 'things', 'selected', 'words', 'models', 'draft') && draw(state);
}
