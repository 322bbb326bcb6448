/**
 * Habits of a home: an object class, or a relation of two classes, in a room type. One confirmed scene
 * covers a habit, so the page asks about it once.
 */

import { plain, wordOf } from './words.js';

/** The habit behind an alarm, as one text. @param {string[]} about the class, or class, relation and class */
export const habitOf = (about, room) => JSON.stringify([plain(room ?? ''), ...about]);

/**
 * The classes of an alarm: the class of an object, or those of a misplaced relation.
 * @param {Map<string, string>} classes the class of each object
 */
export const aboutOf = (one, classes) => (one.relation
  ? [classes.get(one.subject) ?? one.subject, one.relation, classes.get(one.object) ?? one.object] : [one.label]);

/** The class of each object of an answer about outliers. */
export const classesOf = ({ outliers }) => new Map(outliers.map(({ object, label }) => [object, label]));

/**
 * The alarms of an answer about outliers.
 * @returns {{words: string, about: string[], labels: string[]}[]} `labels` are those of the objects in the request
 */
export function alarmsOf(answer) {
  if (!answer) return [];
  const { outliers, misplaced } = answer;
  const classes = classesOf(answer);
  const names = new Map(outliers.map((one) => [one.object, wordOf(one)]));
  return [
    ...outliers.filter((one) => one.is_outlier).map((one) => ({ words: wordOf(one), about: aboutOf(one, classes), labels: [wordOf(one)] })),
    ...misplaced.filter((one) => one.is_misplaced).map((one) => ({
      words: `place of ${names.get(one.subject) ?? one.subject}`, about: aboutOf(one, classes),
      labels: [one.subject, one.object].flatMap((id) => names.get(id) ?? []),
    })),
  ];
}
