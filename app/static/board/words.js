/** Search in a vocabulary by labels and aliases, tolerant of spelling. */

/** @typedef {{label: string, aliases: string[], structure: boolean}} Entry */

const plain = (text) => text.toLowerCase().replace(/[\s_-]+/g, ' ').trim();

function rank(name, wanted) {
  if (name === wanted) return 0;
  if (name.startsWith(wanted)) return 1;
  if (name.includes(` ${wanted}`)) return 2;
  return name.includes(wanted) ? 3 : Infinity;
}

const MOST_TYPOS = 2;

/** Possible singulars of a plural such as "tvs", "shelves" or "boxes". */
const singulars = (text) =>
  [[/s$/, ''], [/es$/, ''], [/ies$/, 'y'], [/ves$/, 'f']]
    .filter(([ending]) => ending.test(text)).map(([ending, instead]) => text.replace(ending, instead));

/** Number of wrong, missing, extra or swapped letters; Infinity if the lengths differ too much. */
function typos(a, b) {
  if (Math.abs(a.length - b.length) > MOST_TYPOS) return Infinity;
  const rows = [[...Array(b.length + 1).keys()]];
  for (let i = 1; i <= a.length; i += 1) {
    rows.push([i]);
    for (let j = 1; j <= b.length; j += 1) {
      let least = Math.min(rows[i - 1][j] + 1, rows[i][j - 1] + 1, rows[i - 1][j - 1] + Number(a[i - 1] !== b[j - 1]));
      if (i > 1 && j > 1 && a[i - 1] === b[j - 2] && a[i - 2] === b[j - 1]) least = Math.min(least, rows[i - 2][j - 2] + 1);
      rows[i].push(least);
    }
  }
  return rows[a.length][b.length];
}

/** Number of typing errors, or Infinity if there are too many; short words allow fewer errors. */
function unlike(name, wanted) {
  const wrong = typos(name, wanted);
  return wrong <= Math.min(MOST_TYPOS, Math.floor(wanted.length / 3)) ? wrong : Infinity;
}

/**
 * Entries that match the text, else its singular, else names with few typing errors.
 * @param {Entry[]} entries
 * @returns {{label: string, alias: string | null}[]} best first; `alias` is the matching name, if not the label
 */
export function search(entries, text, limit = 12) {
  const wanted = plain(text);
  for (const name of [wanted, ...singulars(wanted)]) {
    const found = fitting(entries, name, rank);
    if (found.length) return found.slice(0, limit);
  }
  return fitting(entries, wanted, unlike).slice(0, limit);
}

/**
 * Matching entries, best first.
 * @param {Entry[]} entries
 * @param {(name: string, wanted: string) => number} rank lower is better
 */
function fitting(entries, wanted, rank) {
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
  return found.sort((a, b) => a.best - b.best);
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
};

export const percent = (probability) =>
  probability > 0 && probability < 0.01 ? '< 1 %' : `${Math.round(100 * probability)} %`;
