/** The questions as tabs (WAI-ARIA pattern). */

import { changed } from './store.js';

export function tabs(list, store) {
  const all = [...list.querySelectorAll('[role=tab]')];
  const nameOf = (tab) => tab.id.replace('tab-', '');
  const go = (tab) => {
    store.set({ tab: nameOf(tab) });
    tab.focus();
  };
  list.addEventListener('click', (event) => {
    const tab = event.target.closest('[role=tab]');
    if (tab) go(tab);
  });
  list.addEventListener('keydown', (event) => {
    const index = all.indexOf(document.activeElement);
    const steps = { ArrowRight: index + 1, ArrowLeft: index - 1 + all.length, Home: 0, End: all.length - 1 };
    if (!(event.key in steps)) return;
    event.preventDefault();
    go(all[steps[event.key] % all.length]);
  });
  function draw(state) {
    for (const tab of all) {
      const chosen = nameOf(tab) === state.tab;
      tab.setAttribute('aria-selected', String(chosen));
      tab.tabIndex = chosen ? 0 : -1;
      document.getElementById(tab.getAttribute('aria-controls')).hidden = !chosen;
    }
  }
  draw(store.get());
  return (state, previous) => changed(state, previous, 'tab') && draw(state);
}
