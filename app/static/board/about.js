/** The models that answer, and their terms of use. */

import { call } from './api.js';
import { el } from './dom.js';
import { shown } from './words.js';

const MOST_LETTERS = 200; // of the terms of a model

/** The model of the first answer of a column, or undefined. */
const answering = (own) => Object.values(own).find(({ answer }) => answer)?.answer.model;

/** @returns {Promise<{flag: string, terms: string}>} */
async function termsOf({ name, version }) {
  const { data, terms } = await call(`models/${encodeURIComponent(name)}/versions/${encodeURIComponent(version)}`);
  return { flag: data.some((one) => one.research_only) ? 'research only, no commercial use' : 'commercial use allowed', terms };
}

export function createAbout(store, node) {
  const known = new Map(); // name and version → terms; null while the page asks
  let told = '';

  async function learn(model, key) {
    known.set(key, null);
    try {
      known.set(key, await termsOf(model));
    } catch {
      known.delete(key); // The next answer asks again.
    }
    draw();
  }

  function draw() {
    const models = new Map(store.get().answers.map(answering).filter(Boolean).map((model) => [`${model.name} ${model.version}`, model]));
    if (!models.size) return; // The last answering model stays on the screen.
    for (const [key, model] of models) if (!known.has(key)) void learn(model, key);
    const words = JSON.stringify([...models.keys()].map((key) => [key, known.get(key)]));
    if (words === told) return;
    told = words;
    node.replaceChildren(...[...models.keys()].flatMap((key) => {
      const { flag, terms } = known.get(key) ?? {};
      return [`Model ${shown(key)}${flag ? ': ' : '. '}`, ...(flag ? [el('b', {}, flag), '. '] : []),
        terms ? el('span', { class: 'terms' }, `Terms: ${shown(terms, MOST_LETTERS)} `) : ''];
    }), 'A request is about one room.');
  }

  return (state, previous) => state.answers !== previous.answers && draw();
}
