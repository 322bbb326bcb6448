/** Shows that the service is down, waits for it, and then sends all questions again. */

import { service } from './api.js';

const EVERY = 1500; // ms

export function watchService(store, banner, whenBack) {
  let waiting = false;

  async function wait() {
    waiting = true;
    banner.textContent = 'The service does not answer. The page keeps your scene and tries again until the service answers.';
    banner.hidden = false;
    for (;;) {
      await new Promise((resolve) => setTimeout(resolve, EVERY));
      try {
        if ((await fetch(`${service}/health/ready`)).ok) break;
      } catch {
        continue;
      }
    }
    banner.hidden = true;
    waiting = false;
    store.set({ down: false, epoch: store.get().epoch + 1 });
    whenBack();
  }

  store.subscribe((state) => {
    if (state.down && !waiting) void wait();
  });
}
