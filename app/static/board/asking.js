/**
 * Sends the questions again after each change of the board or a setting. It waits until changes
 * pause, and aborts earlier requests.
 */

import { call, ProblemError, UnreachableError } from './api.js';
import { ASKED, bodyOf, DEPENDS } from './questions.js';
import { changed } from './store.js';

const STILL = 120; // ms

export function startAsking(store) {
  const under = new Map(); // "column/question" → {text, controller}
  let timer = 0;

  function put(column, question, entry) {
    const answers = store.get().answers.map((own, index) =>
      index === column ? { ...own, [question]: { ...own[question], ...entry } } : own,
    );
    store.set({ answers });
  }

  async function ask(column, question) {
    const state = store.get();
    const place = `${column}/${question}`;
    const body = bodyOf(state, question, state.models[column]);
    const text = JSON.stringify([body, state.epoch]);
    // A change of the model clears its answers.
    const isAsked = Boolean(state.answers[column][question]?.status);
    if (isAsked && under.get(place)?.text === text) return;
    under.get(place)?.controller.abort();
    const controller = new AbortController();
    under.set(place, { text, controller });
    if (!body) {
      put(column, question, { status: 'none', answer: null, problem: null, body: null });
      return;
    }
    put(column, question, { status: 'asking', body });
    try {
      const answer = await call(question, body, controller.signal);
      put(column, question, { status: 'answered', answer, problem: null, body });
    } catch (error) {
      if (controller.signal.aborted) return;
      fail(column, question, error, place);
    }
  }

  function fail(column, question, error, place) {
    if (error instanceof UnreachableError) {
      put(column, question, { status: 'down', problem: null });
      store.set({ down: true });
    } else if (error instanceof ProblemError) {
      put(column, question, { status: 'refused', answer: null, problem: error.problem });
      if (error.retryAfter) {
        setTimeout(() => {
          under.delete(place);
          askAll();
        }, 1000 * error.retryAfter);
      }
    } else {
      throw error;
    }
  }

  function askAll() {
    for (const question of ASKED) {
      for (const column of [0, 1]) void ask(column, question);
    }
  }

  store.subscribe((state, previous) => {
    if (!changed(state, previous, ...DEPENDS)) return;
    clearTimeout(timer);
    timer = setTimeout(askAll, STILL);
  });
  timer = setTimeout(askAll, 0);
}
