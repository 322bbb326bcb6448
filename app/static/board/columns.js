/** The answers as text: one column per question and model. */

import { listed } from './edges.js';
import { accept, ghostsOf } from './ghosts.js';
import { bar, copy, el, redraw } from './dom.js';
import { curl, python } from './calls.js';
import { complaint, placeOf } from './list.js';
import { QUESTIONS } from './questions.js';
import { changed } from './store.js';
import { percent, SPOKEN } from './words.js';

const SEEN = ['answers', 'shown', 'selected', 'own', 'models', 'things', 'tab', 'draft', 'words', 'at'];
const signed = (value) => (value > 0 ? `+${value.toFixed(1)}` : value.toFixed(1).replace('-', '−'));

const reasons = (because) =>
  because.map(({ object, log_odds_change: change }) => `${object} ${signed(change)}`).join(', ');

/** The evidence on an object: against it if it is an outlier, else for it. */
const support = ({ is_outlier: out, because, usually_with: company = [] }) =>
  [
    because.length ? `${out ? 'against' : 'for'}: ${reasons(because)}` : '',
    company.length ? `usually with: ${company.join(', ')}` : '',
  ].filter(Boolean).join(' · ');

/** Notes of an answer on the scene: ignored labels, mapped labels and warnings. */
const notes = ({ ignored = [], mapped = [], warnings = [] }) =>
  [
    ignored.length ? `Ignored: ${ignored.join(', ')}.` : '',
    mapped.length ? `Mapped to the nearest class: ${mapped.map((one) => `${one.label} → ${one.class}`).join(', ')}.` : '',
    ...warnings.map((one) => `Check ${one.objects.join(', ')}: ${one.message}.`),
  ].filter(Boolean).join(' ');

const ROWS = {
  missing(answer, state, store, column) {
    const ghosts = new Map(column === state.shown ? ghostsOf(state).map((ghost) => [ghost.label, ghost]) : []);
    return answer.missing.map(({ label, probability, placements, because = [] }) => {
      const places = placements.map((one) => `${SPOKEN[one.relation]} ${one.object} ${percent(one.probability)}`);
      const ghost = ghosts.get(label);
      return el('li', {},
        el('div', { class: 'headline' }, el('b', {}, label), el('span', {}, percent(probability)),
          ghost ? el('button', {
            type: 'button', class: 'icon', 'data-key': `add-${label}`,
            'aria-label': `Put ${label} ${SPOKEN[ghost.placement.relation]} ${ghost.placement.object}`,
            onclick: () => accept(store, ghost),
          }, '+') : null),
        bar(probability, 'missing'),
        places.length ? el('p', { class: 'quiet' }, places.join(' · ')) : null,
        because.length ? el('p', { class: 'quiet reasons' }, `because of ${reasons(because)}`) : null);
    });
  },

  outliers(answer, state, store) {
    const rows = answer.outliers.map((one) =>
      el('li', { class: one.is_outlier ? 'alarm' : '' },
        el('div', { class: 'headline' },
          el('button', {
            type: 'button', class: 'link', 'data-key': `of-${one.object}`,
            onclick: () => store.set({ selected: one.object }),
          }, one.object),
          one.is_outlier ? el('span', { class: 'flag' }, 'does not belong') : null,
          el('span', {}, percent(one.probability))),
        bar(one.probability, 'outliers'),
        support(one) ? el('p', { class: 'quiet reasons' }, support(one)) : null));
    const misplaced = answer.misplaced.filter((one, index) => index < 12 || one.is_misplaced).map((one) =>
      el('li', { class: one.is_misplaced ? 'alarm' : '' },
        el('div', { class: 'headline' }, el('span', { class: 'grow' }, `${one.subject} ${SPOKEN[one.relation]} ${one.object}`),
          el('span', {}, percent(one.probability))),
        bar(one.probability, 'outliers')));
    if (!misplaced.length) return rows;
    return [...rows, el('li', { class: 'heading' }, el('h4', {}, 'In the wrong place?')), ...misplaced];
  },

  relations(answer, state) {
    const odd = listed(state, answer.disagreements).map((one) =>
      el('li', { class: 'disagrees' },
        el('div', { class: 'headline' },
          el('span', { class: 'grow' }, `${one.subject} ${one.observed.map((name) => SPOKEN[name]).join(', ')} ${one.object}`),
          el('span', {}, percent(one.observed_probability))),
        el('p', {}, `expected: ${SPOKEN[one.expected]}, ${percent(one.probability)}`)));
    const rows = listed(state, answer.relations).map((one) =>
      el('li', { class: one.observed ? 'holds' : 'expected' },
        el('div', { class: 'headline' },
          el('span', { class: 'grow' }, `${one.subject} ${SPOKEN[one.relation]} ${one.object}`),
          one.observed ? el('span', { class: 'flag' }, 'observed') : null,
          el('span', {}, percent(one.probability))),
        bar(one.probability, 'relations')));
    return [...odd, ...rows];
  },
};

const NOTHING = {
  missing: 'The model suggests no object.',
  outliers: 'The model knows none of the objects.',
  relations: 'No relation reaches the minimum probability.',
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

/** A problem document as text. Each error names its object of the request. */
export function problemWords(problem, body) {
  const errors = (problem.errors ?? []).map((error) => {
    const about = body?.objects[placeOf(error)]?.id;
    return el('li', {}, about ? `${about}: ${complaint(error)}` : complaint(error));
  });
  return [
    el('b', {}, problem.title), el('p', {}, problem.detail ?? ''),
    errors.length ? el('ul', {}, ...errors) : null,
    el('p', { class: 'quiet' }, `request ${problem.request_id ?? 'unknown'}`),
  ].filter(Boolean);
}

export function createColumns(store, parents, askKey) {
  const made = new Map();
  for (const question of QUESTIONS) {
    for (const column of [0, 1]) {
      const own = {
        title: el('h3'), problem: el('div', { class: 'problem', role: 'alert', hidden: true }), rows: el('ol'),
        note: el('p', { class: 'quiet' }), calls: calls(),
      };
      own.show = el('button', { type: 'button', onclick: () => store.set({ shown: column }) }, 'show on the board');
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
    own.title.textContent = answer ? `${answer.model.name} ${answer.model.version}` : model;
    own.show.hidden = !state.models[1];
    own.show.setAttribute('aria-pressed', String(state.shown === column));
    own.problem.hidden = !problem;
    if (problem && own.told !== problem) {
      own.problem.replaceChildren(...problemWords(problem, entry.body), ...(problem.status === 401 ? [askKey()] : []));
    }
    own.told = problem;
    const rows = answer ? ROWS[question](answer, state, store, column) : [];
    redraw(own.rows, rows);
    const said = answer ? notes(answer) : '';
    const waiting = status === 'down' ? 'Waiting for the service.' : !state.things.length ? 'Put an object on the board first.' : '';
    own.note.textContent = `${said} ${rows.length ? '' : answer ? NOTHING[question] : waiting}`.trim();
    own.calls.show(question, entry.body);
  }

  return (state, previous) => {
    if (!changed(state, previous, ...SEEN)) return;
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
