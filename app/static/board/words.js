/** Searching a vocabulary: labels and aliases, however they are spelled. */

/** @typedef {{label: string, aliases: string[], structure: boolean}} Entry */

const plain = (text) => text.toLowerCase().replace(/[\s_-]+/g, ' ').trim();

function rank(name, wanted) {
  if (name === wanted) return 0;
  if (name.startsWith(wanted)) return 1;
  if (name.includes(` ${wanted}`)) return 2;
  return name.includes(wanted) ? 3 : Infinity;
}

const MOST_TYPOS = 2;

/** What a plural may be one of: "tvs", "shelves", "boxes". */
const singulars = (text) =>
  [[/s$/, ''], [/es$/, ''], [/ies$/, 'y'], [/ves$/, 'f']]
    .filter(([ending]) => ending.test(text)).map(([ending, instead]) => text.replace(ending, instead));

/** How many letters are wrong, missing, too many or swapped; words much longer or shorter count as all wrong. */
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

/** How unlike a name is to what was typed; short words bear fewer mistakes. */
function unlike(name, wanted) {
  const wrong = typos(name, wanted);
  return wrong <= Math.min(MOST_TYPOS, Math.floor(wanted.length / 3)) ? wrong : Infinity;
}

/**
 * Entries that fit: by what was typed, else by its singular, else those of nearly that name.
 * @param {Entry[]} entries
 * @returns {{label: string, alias: string | null}[]} best first; `alias` is the name that fitted where it was not the label
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
 * Entries that fit, best first.
 * @param {Entry[]} entries
 * @param {(name: string, wanted: string) => number} rank the less the better
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

/** A relation as it is read aloud: "on top of". */
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
