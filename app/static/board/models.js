/** The available models and their vocabularies. */

import { call, UnreachableError } from './api.js';
import { el } from './dom.js';
import { changed } from './store.js';

/** The selectable models: aliases first, then the usable versions without an alias, and the chosen versions. */
function choices({ models, aliases }, chosen) {
  const targets = Object.values(aliases).filter((target) => !chosen.includes(target));
  const versions = models.flatMap(({ name, versions: own }) =>
    own.filter(({ version, status }) => status === 'ready' && !targets.includes(`${name}@${version}`))
      .map(({ version }) => ({ value: `${name}@${version}`, words: `${name} ${version}` })),
  );
  const named = Object.entries(aliases).map(([alias, target]) => ({ value: alias, words: `${alias}: ${target.replace('@', ' ')}` }));
  return [...named, ...versions];
}

/** The usable versions and the aliases, in words. */
const versionsOf = ({ models, aliases }) => new Set([
  ...models.flatMap(({ name, versions }) => versions.filter(({ status }) => status === 'ready').map(({ version }) => `${name} ${version}`)),
  ...Object.entries(aliases).map(([alias, target]) => `${alias} is now ${target.replace('@', ' ')}`),
]);

function words({ objects, room_types: rooms, examples = [] }) {
  return {
    objects, rooms, examples,
    proposed: objects.filter(({ structure }) => !structure).map(({ label }) => label),
    // A Map, because a label such as “constructor” would clash with a property of plain objects.
    hanging: new Set(objects.filter(({ hangs }) => hangs).flatMap(({ label, aliases }) => [label, ...aliases])),
    sizes: new Map(objects.filter(({ size }) => size).flatMap(
      ({ label, aliases, size }) => [label, ...aliases].map((name) => [name, size]))),
  };
}

/** @param {(words: string) => void} announce says that the models of the service have changed */
export function createModels(store, first, second, tell, announce) {
  const asked = new Map(); // model → promise of its vocabulary
  let listed = null; // the last answer of the service about its models
  let refreshing = false;

  async function learn(model) {
    try {
      const found = words(await call(`models/${encodeURIComponent(model)}/vocabulary`));
      store.set({ words: { ...store.get().words, [model]: found } });
    } catch (error) {
      asked.delete(model);
      tell(error);
    }
  }

  function learnAll({ models }) {
    for (const model of models) if (model && !asked.has(model)) asked.set(model, learn(model));
    return Promise.all(models.map((model) => asked.get(model)));
  }

  const options = (found) => found.map(({ value, words: text }) => el('option', { value }, text));

  async function load() {
    try {
      listed = await call('models');
      const found = choices(listed, store.get().models);
      const [model, other] = store.get().models;
      asked.clear();
      // A store without the alias "default" opens with its first model.
      if (!found.some(({ value }) => value === model)) store.set({ models: [found[0]?.value ?? '', other] });
      first.replaceChildren(...options(found));
      second.replaceChildren(el('option', { value: '' }, 'no other model'), ...options(found));
      [first.value, second.value] = store.get().models;
      await learnAll(store.get());
    } catch (error) {
      tell(error);
    }
  }

  const choose = () => {
    const models = [first.value, second.value];
    const { models: before, answers, shown } = store.get();
    store.set({
      models,
      shown: models[1] ? shown : 0,
      answers: answers.map((own, column) => (models[column] === before[column] ? own : {})),
      draft: null,
    });
  };

  /** Loads the models again if the service serves others than the page knows, and says so. */
  async function refresh() {
    if (!listed || refreshing) return;
    refreshing = true;
    try {
      const before = versionsOf(listed);
      const after = versionsOf(await call('models'));
      const news = [...after].filter((one) => !before.has(one));
      if (news.length || [...before].some((one) => !after.has(one))) {
        await load();
        store.set({ epoch: store.get().epoch + 1 }); // ask the questions again
        announce(news.length ? `The service has new models: ${news.join(', ')}.` : 'The service has removed models.');
      }
    } catch (error) {
      if (error instanceof UnreachableError) tell(error);
    } finally {
      refreshing = false;
    }
  }

  /** Whether an answer comes from another version than the list of models says. */
  const isNews = ({ model: answered }, model) => {
    const target = listed?.aliases[model];
    return target !== undefined && target !== `${answered.name}@${answered.version}`;
  };

  addEventListener('focus', () => void refresh());
  store.subscribe((state, previous) => {
    if (state.answers === previous.answers) return;
    const fresh = state.answers.some((own, column) => Object.entries(own).some(([question, { answer }]) =>
      answer && answer !== previous.answers[column][question]?.answer && isNews(answer, state.models[column])));
    if (fresh) void refresh();
  });
  first.addEventListener('change', choose);
  second.addEventListener('change', choose);
  store.subscribe((state, previous) => changed(state, previous, 'models') && void learnAll(state));
  return { load };
}
