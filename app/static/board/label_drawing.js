/**
 * The names of the objects on the board, and the marks of the outliers. A name stands in its box, beside it, or at the end of
 * a line. A name without room appears while its object has the pointer or is selected.
 */

import { joinedPlaces, labelPlaces, LINE, widthOf } from './labels.js';
import { onScreen } from './view.js';

const FONT = '500 13px system-ui, sans-serif';
const MARK = 9; // radius of the mark of an outlier, in pixels
const MOST_JOINED = 60; // names for which a place with a line is sought, so that a drag of 256 objects stays smooth

/** @param {HTMLElement} hint says how many names have no room */
export function createLabels(svg, hint) {
  const layer = svg.append('g').attr('class', 'labels').attr('aria-hidden', 'true');
  const [lines, names, marks, tips] = ['lines', 'names', 'marks', 'tips'].map((name) => layer.append('g').attr('class', name));
  let hidden = new Map(); // id → its name and rectangle
  let pointed = null; // id of the object under the pointer
  let chosen = null; // id of the selected object
  let size = { width: 0, height: 0 };

  /** Shows the hidden name of the object under the pointer, else of the selected one. */
  function drawTip() {
    const tip = hidden.get(pointed) ?? hidden.get(chosen);
    const each = tips.selectAll('g').data(tip ? [tip] : []).join((enter) => {
      const g = enter.append('g');
      g.append('rect').attr('rx', 4);
      g.append('text').attr('class', 'name');
      return g;
    });
    each.classed('outlier', (one) => one.isWrong).each(({ words, rect }, index, nodes) => {
      const width = widthOf(words, FONT) + 12;
      const x = Math.min(Math.max(rect.x, width / 2 + 2), size.width - width / 2 - 2);
      const above = rect.top - LINE - 4;
      const y = above > LINE ? above : rect.bottom + LINE + 4;
      const g = d3.select(nodes[index]);
      g.select('rect').attr('x', x - width / 2).attr('y', y - LINE / 2 - 3).attr('width', width).attr('height', LINE + 6);
      g.select('text').attr('x', x).attr('y', y).text(words);
    });
  }

  /** Draws the mark of each outlier at a corner of its box where it covers no other mark. */
  function drawMarks(boxes, view, places) {
    const taken = [];
    const placed = boxes.map((box) => {
      const { left, right, top, bottom } = onScreen(box, view);
      const corners = [[right, top], [left, top], [right, bottom], [left, bottom]];
      const [x, y] = corners.find((one) => taken.every((other) => Math.hypot(one[0] - other[0], one[1] - other[1]) >= 2 * MARK)) ?? corners[0];
      taken.push([x, y]);
      places.reserve({ left: x - MARK, right: x + MARK, top: y - MARK, bottom: y + MARK });
      return { id: box.id, x, y };
    });
    const each = marks.selectAll('g').data(placed, ({ id }) => id).join((enter) => {
      const g = enter.append('g').attr('class', 'mark');
      g.append('circle').attr('r', MARK);
      g.append('text').attr('class', 'sign').text('!');
      return g;
    });
    each.attr('transform', ({ x, y }) => `translate(${x},${y})`);
  }

  /**
   * @param {{box: object, words: string, isWrong: boolean, first: boolean}[]} entries `first`: its name takes precedence
   * @param {import('./labels.js').Places} places
   */
  function draw(entries, view, places, selected) {
    size = view;
    chosen = selected;
    drawMarks(entries.filter(({ isWrong }) => isWrong).map(({ box }) => box), view, places);
    const rank = ({ isWrong, first }) => (isWrong ? 0 : first ? 1 : 2);
    const area = ({ box }) => box.size.x * box.size.y;
    const texts = [...entries].sort((a, b) => rank(a) - rank(b) || b.box.z - a.box.z || area(a) - area(b))
      .map((entry) => ({ ...entry, id: entry.box.id, width: widthOf(entry.words, FONT) + 6, rect: onScreen(entry.box, view) }));
    for (const text of texts) text.at = places.take(text.width, LINE, labelPlaces(text.rect, text.width), [text.rect]);
    for (const text of texts.filter(({ at }) => !at).slice(0, MOST_JOINED)) {
      text.at = places.join(text.width, LINE, joinedPlaces(text.rect, text.width), text.rect);
    }
    hidden = new Map(texts.filter(({ at }) => !at).map((text) => [text.id, text]));
    const drawn = texts.filter(({ at }) => at);
    names.selectAll('text').data(drawn, ({ id }) => id).join('text')
      .attr('class', 'name').attr('x', ({ at }) => at.x).attr('y', ({ at }) => at.y)
      .classed('outlier', ({ isWrong }) => isWrong).text(({ words }) => words);
    const joined = drawn.filter(({ at }) => at.line);
    const each = lines.selectAll('g').data(joined, ({ id }) => id).join((enter) => {
      const g = enter.append('g');
      g.append('line');
      g.append('circle').attr('r', 2);
      return g;
    }).classed('outlier', ({ isWrong }) => isWrong);
    each.select('line').attr('x1', ({ at }) => at.line[0].x).attr('y1', ({ at }) => at.line[0].y)
      .attr('x2', ({ at }) => at.line[1].x).attr('y2', ({ at }) => at.line[1].y);
    each.select('circle').attr('cx', ({ at }) => at.line[0].x).attr('cy', ({ at }) => at.line[0].y);
    const count = hidden.size;
    hint.hidden = !count;
    hint.textContent = `${count} ${count === 1 ? 'name has' : 'names have'} no room: select an object to see its name.`;
    drawTip();
  }

  return {
    draw,
    /** Notes the object under the pointer. @param {string | null} id */
    point(id) {
      pointed = id;
      drawTip();
    },
  };
}
