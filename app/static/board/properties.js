/** The form with the confidence, pose and size of the selected object. */

import { round } from './geometry.js';
import { sizesOf } from './questions.js';
import { changed } from './store.js';
import { nameOf } from './words.js';

export function createProperties(form, store, actions) {
  const field = (name) => form.elements.namedItem(name);
  const error = document.getElementById('properties-error');
  const typing = new Set(); // fields that a change elsewhere must not overwrite

  function write(input, thing) {
    const { name, value } = input;
    const number = Number(value);
    if (!value || !Number.isFinite(number) || !input.checkValidity()) {
      throw new Error(input.validationMessage || 'This must be a number.');
    }
    if (name === 'x' || name === 'y') {
      actions.place(thing.id, name === 'x' ? number : thing.x, name === 'y' ? number : thing.y, false, true);
    } else if (name.length === 2) {
      actions.change(thing.id, { size: { ...actions.sized()(thing).size, [name[1]]: number } });
    } else {
      actions.change(thing.id, { [name]: number, ...(name === 'z' && { placed: true }) });
    }
  }

  form.addEventListener('submit', (event) => event.preventDefault());
  form.addEventListener('input', ({ target }) => typing.add(target));
  form.addEventListener('focusout', ({ target }) => typing.delete(target));
  form.addEventListener('change', ({ target }) => {
    typing.delete(target);
    const thing = actions.find(store.get().selected);
    if (!thing) return;
    try {
      write(target, thing);
      error.textContent = '';
      target.removeAttribute('aria-invalid');
    } catch (problem) {
      error.textContent = problem.message;
      target.setAttribute('aria-invalid', 'true');
    }
  });

  function draw(state) {
    const thing = state.things.find(({ id }) => id === state.selected);
    form.hidden = !thing || Boolean(state.draft);
    if (form.hidden) return;
    const { size } = actions.sized()(thing);
    form.querySelector('h3').textContent = nameOf(thing);
    for (const set of form.querySelectorAll('fieldset')) set.hidden = !state.posed;
    const known = sizesOf(state, state.models[0]).has(thing.label);
    document.getElementById('size-source').textContent = thing.size ? '' : known ? '(typical)' : '(a guess)';
    document.getElementById('place-source').textContent = thing.placed ? '' : '(not given)';
    const values = { ...thing, sx: size.x, sy: size.y, sz: size.z };
    for (const input of form.querySelectorAll('input')) {
      if (typing.has(input) || (input === document.activeElement && input.getAttribute('aria-invalid'))) continue;
      const text = String(round(values[input.name]));
      if (field(input.name).value !== text) input.value = text;
      input.removeAttribute('aria-invalid');
    }
  }

  return (state, previous) =>
    changed(state, previous, 'things', 'selected', 'words', 'models', 'draft', 'posed') && draw(state);
}
