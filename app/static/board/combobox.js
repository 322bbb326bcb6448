/** The search for objects: an editable combobox with a list (WAI-ARIA pattern). */

import { search } from './words.js';

/**
 * @param {HTMLInputElement} input
 * @param {HTMLUListElement} list
 * @param {() => import('./words.js').Entry[]} entries
 * @param {(label: string) => void} choose gets a label of the list, or another text that the user typed
 */
export function combobox(input, list, entries, choose) {
  let found = [];
  let active = -1;
  let pressing = false;

  function show(open) {
    list.hidden = !open || !found.length;
    input.setAttribute('aria-expanded', String(!list.hidden));
  }

  function point(index) {
    active = index;
    [...list.children].forEach((option, at) => option.setAttribute('aria-selected', String(at === index)));
    const option = list.children[index];
    if (option) {
      input.setAttribute('aria-activedescendant', option.id);
      option.scrollIntoView({ block: 'nearest' });
    } else {
      input.removeAttribute('aria-activedescendant');
    }
  }

  function refresh() {
    found = search(entries(), input.value);
    list.replaceChildren(
      ...found.map(({ label, alias }, index) => {
        const option = document.createElement('li');
        option.id = `${list.id}-${index}`;
        option.setAttribute('role', 'option');
        option.draggable = true;
        option.dataset.label = label;
        option.textContent = label;
        if (alias) {
          const also = document.createElement('span');
          also.className = 'quiet';
          also.textContent = ` ${alias}`;
          option.append(also);
        }
        return option;
      }),
    );
    point(-1);
    show(true);
  }

  function take(label) {
    input.value = '';
    show(false);
    point(-1);
    choose(label);
  }

  function enter() {
    const text = input.value.trim();
    if (text) take((found[active] ?? search(entries(), text)[0])?.label ?? text);
    else if (found[active]) take(found[active].label);
  }

  const keys = {
    ArrowDown: () => (list.hidden ? refresh() : point((active + 1) % found.length)),
    ArrowUp: () => (list.hidden ? refresh() : point((active <= 0 ? found.length : active) - 1)),
    Enter: enter,
    Escape: () => {
      if (list.hidden) input.value = '';
      show(false);
      point(-1);
    },
  };
  input.addEventListener('input', refresh);
  input.addEventListener('click', () => list.hidden && refresh());
  input.addEventListener('keydown', (event) => {
    if (event.isComposing || !keys[event.key]) return;
    event.preventDefault();
    keys[event.key]();
  });
  // A press in the list moves the focus away, but it may start a drag to the board.
  list.addEventListener('pointerdown', () => (pressing = true));
  document.addEventListener('pointerup', () => (pressing = false));
  input.addEventListener('blur', () => !pressing && show(false));
  list.addEventListener('click', (event) => {
    const option = event.target.closest('[role=option]');
    if (option) take(option.dataset.label);
    input.focus();
  });
  list.addEventListener('dragstart', (event) => {
    event.dataTransfer.setData('text/plain', event.target.dataset.label);
    event.dataTransfer.effectAllowed = 'copy';
  });
  list.addEventListener('dragend', () => {
    pressing = false;
    show(false);
  });
}
