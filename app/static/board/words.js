/** Search in a vocabulary by labels and aliases, and words for answers. */

/** @typedef {{label: string, aliases: string[], structure: boolean}} Entry */

/** A label for comparisons: in lower case, with single spaces. A file may have a number in its place. */
export const plain = (text) => String(text).toLowerCase().replace(/[\s_-]+/g, ' ').trim();

function rank(name, wanted) {
  if (name === wanted) return 0;
  if (name.startsWith(wanted)) return 1;
  if (name.includes(` ${wanted}`)) return 2;
  return name.includes(wanted) ? 3 : Infinity;
}

/**
 * Entries that match the text. The service resolves plurals and typing errors of other texts.
 * @param {Entry[]} entries
 * @returns {{label: string, alias: string | null}[]} best first; `alias` is the matching name, if not the label
 */
export function search(entries, text, limit = 12) {
  const wanted = plain(text);
  const found = [];
  for (const entry of entries) {
    let best = wanted ? rank(plain(entry.label), wanted) : Number(entry.structure);
    let alias = null;
    if (wanted && best > 0) {
      for (const name of entry.aliases) {
        const other = rank(plain(name), wanted) + 0.5;
        if (other < best) [best, alias] = [other, name];
      }
    }
    if (best < Infinity) found.push({ label: entry.label, alias, best });
  }
  return found.sort((a, b) => a.best - b.best).slice(0, limit);
}

const MOST_SHOWN = 48; // characters of a name
/** Characters that the service refuses in names too: controls, line breaks, directions of text, unusual blanks. */
const UNPRINTABLE = /[\p{C}\p{Zl}\p{Zp}]|(?! )\p{Zs}/gu;
const RIGHT_TO_LEFT = /[\u0590-\u08ff\ufb1d-\ufdff\ufe70-\ufefc]/;

/** A text of a request or a file for display: in one line and of bounded length. It turns no text beside it. */
export function shown(text, most = MOST_SHOWN) {
  const own = String(text);
  const line = own.slice(0, 2 * most).replace(UNPRINTABLE, '\ufffd');
  const letters = [...line];
  const cut = letters.length > most || line.length < own.length ? `${letters.slice(0, most - 1).join('')}…` : line;
  return RIGHT_TO_LEFT.test(cut) ? `\u2068${cut}\u2069` : cut; // isolates the direction of the name
}

/** The name of an object: its id, with its label if the id does not begin with it, as in "desk (track_3)". */
export const nameOf = ({ id, label }) => (
  `${plain(id)} `.startsWith(`${plain(label)} `) ? shown(id) : `${shown(label)} (${shown(id)})`);

/** The word of the request for a class of an answer. */
export const wordOf = ({ label, listed_as: word }) => word ?? label;

/** A function from the id of an object to its name. */
export function namesOf(things) {
  const names = new Map(things.map((thing) => [thing.id, nameOf(thing)]));
  return (id) => names.get(id) ?? shown(id);
}

/** Relations in words, for example "on top of". */
export const SPOKEN = {
  left: 'left of',
  right: 'right of',
  front: 'in front of',
  behind: 'behind',
  'on-top': 'on top of',
  under: 'under',
  above: 'above',
  below: 'below',
  inside: 'in',
  contains: 'containing',
};

export const percent = (probability) =>
  probability > 0 && probability < 0.01 ? '<\u00a01\u00a0%' : `${Math.round(100 * probability)}\u00a0%`;

/** The labels of an object with alternatives, likeliest first: "bowl 72 %, cup 28 %". */
export const resolvedWords = ({ labels }) => labels.map(({ label, probability }) => `${label} ${percent(probability)}`).join(', ');
