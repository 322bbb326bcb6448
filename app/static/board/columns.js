/** The answers as text: one column per question and model. */

import { curl, python } from './calls.js';
import { copy, el, redraw } from './dom.js';
import { accept, ghostsOf, likely, SHIFTED } from './ghosts.js';
import { common, inWords, QUESTIONS, reading, whyNot } from './questions.js';
import { classOf, createFolds, reasons, row, some, spoken, verdict } from './rows.js';
import { changed } from './store.js';
import { namesOf, percent, shown, SPOKEN, wordOf } from './words.js';
import { wrongRows } from './wrong.js';

const SEEN = ['answers', 'shown', 'models', 'things', 'tab', 'draft', 'words', 'at', 'posed', 'relations', 'room', 'right', 'line', 'covered'];

const PLACES = 2; // listed places of a missing object, likeliest first

/** What a model did with unknown names, and the warnings of its answer. */
function notes({ warnings = [] }, state, column, name, question) {
  const names = [...new Set(state.things.map(({ label }) => label))].map((label) => reading(state, column, 'objects', label));
  return [
    ...[...names, reading(state, column, 'rooms', state.room)].map(inWords).filter(Boolean).map((words) => (words.endsWith('?') ? words : `${words}.`)),
    // The list of outliers shows the split of the objects.
    ...warnings.filter(({ code }) => code !== 'several-rooms' || question !== 'outliers').map(({ objects, message }) =>
      (objects.length ? `Check ${some(objects.map(name))}: ${message}.` : `Note: ${message}.`)),
  ].join(' ');
}

/** Whether the model answers a question: the training scenes of a model may have no relations. */
const judges = (answer) => !answer?.warnings?.some(({ code }) => code === 'not-judged');

/** Says why missing objects have no reasons: only objects that change the odds by a factor of 3 are reasons. */
function unexplained({ missing }, { room }) {
  if (!missing.length || missing.some(({ because = [] }) => because.length)) return '';
  return `No single object decides these: ${room ? 'the room type and all objects together do' : 'all objects together do'}.`;
}

const ROWS = {
  missing(answer, name, state, store, column, verdicts) {
    const ghosts = new Map(column === state.shown ? ghostsOf(state).map((ghost) => [ghost.label, ghost]) : []);
    const nowhere = judges(state.answers[column].relations?.answer) ? 'no likely place' : '';
    const rows = likely(state.answers[column], state).map(({ label, probability, placements, because = [] }) => {
      const ghost = ghosts.get(label);
      const first = placements.slice(0, PLACES);
      // The place on the board is always listed.
      if (ghost && placements.indexOf(ghost.placement) >= PLACES) first.splice(-1, 1, ghost.placement);
      const places = first.map((one) => `${SPOKEN[one.relation]} ${name(one.object)} ${percent(one.probability)}`);
      if (places.length && !ghost && column === state.shown) places.push('no free place on the board');
      if (ghost?.shifted) places.push(SHIFTED);
      const button = ghost && el('button', {
        type: 'button', class: 'icon', 'data-key': `add-${label}`,
        'aria-label': `Put ${label} ${SPOKEN[ghost.placement.relation]} ${name(ghost.placement.object)}`,
        // The second click of a double click would take the next suggestion.
        onclick: ({ detail }) => detail < 2 && accept(store, ghost),
      }, '+');
      const isThere = verdict('Is there', label, () => verdicts.isThere(label, ghost));
      return [probability, row('missing', el('b', {}, label), probability, { buttons: [...(ghost ? [button] : []), isThere] },
        el('p', { class: 'quiet' }, places.join(' · ') || nowhere), reasons(because, name))];
    });
    // An answer about chosen classes also has improbable instances.
    const further = answer.more.filter((one) => one.probability >= 0.5).map((one) =>
      [one.probability, row('missing', el('b', {}, `another ${wordOf(one)}`), one.probability, {}, classOf(one),
        el('p', { class: 'quiet' }, `${one.listed_count} listed, about ${Math.round(one.expected_count)} expected`))]);
    return [...rows, ...further].sort(([a], [b]) => b - a).map(([, node]) => node);
  },

  outliers: wrongRows,

  relations: ({ disagreements, relations }, name) => [
    ...disagreements.map((one) =>
      el('li', { class: 'disagrees' },
        el('div', { class: 'headline' },
          el('b', {}, `${name(one.subject)} ${one.observed.map((relation) => SPOKEN[relation]).join(', ')} ${name(one.object)}`),
          el('span', {}, percent(one.observed_probability))),
        el('p', {}, `expected: ${SPOKEN[one.expected]}, ${percent(one.probability)}`))),
    ...relations.map((one) =>
      row('relations', el('b', {}, spoken(one, name)), one.probability,
        one.observed ? { kind: 'holds', words: 'observed' } : { kind: 'expected' },
        one.expected == null ? null : el('p', { class: 'quiet' }, `if not observed: ${percent(one.expected)}`))),
  ],
};

const NOTHING = {
  missing: 'The model suggests no object.',
  outliers: '',
  relations: 'No relation between these objects is likely.',
};

/** A collapsible section with the commands that send a request; `show` fills it. */
export function calls() {
  const block = (name) => {
    const code = el('pre', { tabindex: 0, 'aria-label': `${name} call` });
    const done = el('span', { role: 'status' });
    const button = el('button', {
      type: 'button', 'aria-label': `Copy the ${name} call`,
      onclick: async () => {
        await copy(code.textContent);
        done.textContent = 'copied';
        setTimeout(() => (done.textContent = ''), 2000);
      },
    }, 'Copy');
    return { code, node: el('div', { class: 'call' }, el('div', { class: 'row' }, el('b', {}, name), button, done), code) };
  };
  const [shell, py] = [block('curl'), block('Python')];
  const node = el('details', { class: 'calls' }, el('summary', {}, 'Send this request from a program'), shell.node, py.node);
  return {
    node,
    show(question, body) {
      node.hidden = !body;
      if (!body) return;
      shell.code.textContent = curl(question, body);
      py.code.textContent = python(question, body);
    },
  };
}

/** A problem document as text. Each error names its object, room or label of the request. */
export function problemWords(problem, body) {
  const errors = (problem.errors ?? []).map(({ pointer, message, suggestions = [] }) => {
    const [, field, index] = /^#\/(objects|rooms|label)(?:\/(\d+))?/.exec(pointer) ?? [];
    const about = field === 'label' ? body?.label : body?.[field]?.[index]?.id;
    return el('li', {}, `${about ? `${shown(about)}: ` : ''}${message}${suggestions.length ? ` (${suggestions.join(', ')}?)` : ''}`);
  });
  return [
    el('b', {}, problem.title), el('p', {}, problem.detail ?? ''),
    errors.length ? el('ul', {}, ...errors) : null,
    el('p', { class: 'quiet' }, `request ${problem.request_id ?? 'unknown'}`),
  ].filter(Boolean);
}

export function createColumns(store, parents, askKey, verdicts) {
  const made = new Map();
  const folds = createFolds();
  for (const question of QUESTIONS) {
    for (const column of [0, 1]) {
      const own = {
        title: el('h3'), problem: el('div', { class: 'problem', role: 'alert', hidden: true }), rows: el('ol'),
        note: el('p', { class: 'quiet' }), calls: calls(),
      };
      own.show = el('button', { type: 'button', onclick: () => store.set({ shown: column }) }, 'on the board');
      own.node = el('article', {}, el('header', {}, own.title, own.show), own.problem, own.note, own.rows, own.calls.node);
      parents(question).append(own.node);
      made.set(`${column}/${question}`, own);
    }
  }

  function draw(state, question, column) {
    const own = made.get(`${column}/${question}`);
    const model = state.models[column];
    own.node.hidden = !model;
    if (!model) return;
    const entry = state.answers[column][question] ?? {};
    const { answer, problem, status } = entry;
    own.title.parentElement.hidden = !state.models[1];
    own.title.textContent = answer ? `${answer.model.name} ${answer.model.version}` : model;
    own.show.setAttribute('aria-pressed', String(state.shown === column));
    own.problem.hidden = !problem;
    if (problem && own.told !== problem) {
      own.problem.replaceChildren(...problemWords(problem, entry.body), ...(problem.status === 401 ? [askKey()] : []));
    }
    own.told = problem;
    const name = namesOf(state.things);
    const rows = answer ? ROWS[question](answer, name, state, store, column, verdicts, folds) : [];
    redraw(own.rows, rows);
    const waiting = status === 'down' ? 'Waiting for the service.' : whyNot(state, question, model);
    const shared = question === 'missing' && column === 0 && common(state);
    own.note.textContent = [
      question === 'outliers' && answer?.threshold !== undefined ? `An object raises an alarm from ${percent(answer.threshold)}.` : '',
      shared ? `Both models answer about their ${shared.length} common classes.` : '',
      question === 'missing' && answer ? unexplained(answer, state) : '',
      notes(answer ?? {}, state, column, name, question), rows.length || !judges(answer) ? '' : answer ? NOTHING[question] : waiting,
    ].filter(Boolean).join(' ');
    own.calls.show(question, entry.body);
  }

  return (state, previous) => {
    if (!changed(state, previous, ...SEEN)) return;
    if (state.line.scene_id !== previous.line?.scene_id) folds.clear();
    for (const question of QUESTIONS) {
      for (const column of [0, 1]) {
        const busy = state.answers[column][question]?.status === 'asking';
        made.get(`${column}/${question}`).node.setAttribute('aria-busy', String(busy));
        // Hidden columns are drawn when their tab opens.
        if (question === state.tab || state.tab !== previous.tab) draw(state, question, column);
      }
    }
  };
}
