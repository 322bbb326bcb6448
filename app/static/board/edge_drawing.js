/** Relations as arrows from subject to object, with texts that do not overlap. */

import { labelPlaces, widthOf } from './labels.js';
import { onScreen } from './view.js';

const FONT = '11px system-ui, sans-serif';
const PADDING = 6; // pixels

/** The point where the line from a box's centre to another point leaves the box. */
function border(box, towards) {
  const [dx, dy] = [towards.x - box.x, towards.y - box.y];
  const reach = Math.min(
    dx ? (box.right - box.left) / 2 / Math.abs(dx) : Infinity,
    dy ? (box.bottom - box.top) / 2 / Math.abs(dy) : Infinity,
  );
  return reach >= 1 ? null : { x: box.x + dx * reach, y: box.y + dy * reach };
}

function line(edge, rects) {
  const [a, b] = [rects.get(edge.subject), rects.get(edge.object)];
  if (!a || !b) return null;
  const [from, to] = [border(a, b), border(b, a)];
  // If one box lies on the other, only the text is drawn.
  const width = widthOf(edge.words, FONT) + PADDING;
  if (!from || !to) return { ...edge, width, ends: [a, b], from: null, spots: labelPlaces(a, width) };
  const at = (part) => ({ x: from.x + (to.x - from.x) * part, y: from.y + (to.y - from.y) * part });
  const length = Math.hypot(to.x - from.x, to.y - from.y) || 1;
  const [nx, ny] = [(from.y - to.y) / length, (to.x - from.x) / length];
  const aside = (by) => ({ x: at(0.5).x + nx * by, y: at(0.5).y + ny * by });
  const spots = [...[0.5, 0.38, 0.62, 0.25, 0.75].map(at), ...[12, -12, 24, -24, 38, -38].map(aside)];
  return { ...edge, width, ends: [a, b], from, to, spots };
}

export function drawEdges(layer, edges, boxes, view, places) {
  const rects = new Map(boxes.map((box) => [box.id, onScreen(box, view)]));
  const lines = edges.map((edge) => line(edge, rects)).filter(Boolean);
  for (const one of lines) one.text = places.take(one.width, 15, one.spots, one.ends);
  const each = layer.selectAll('g').data(lines, (one) => one.key).join((enter) => {
    const g = enter.append('g');
    g.append('path').attr('class', 'line');
    g.append('path').attr('class', 'head').attr('d', 'M0,0 L-8,-4 L-8,4 Z');
    g.append('text');
    return g;
  });
  each.attr('class', (one) => one.kind);
  each.select('.line').attr('d', (one) => (one.from ? `M${one.from.x},${one.from.y} L${one.to.x},${one.to.y}` : null));
  each.select('.head').attr('visibility', (one) => (one.from ? null : 'hidden')).attr('transform', (one) => {
    if (!one.from) return null;
    const angle = (Math.atan2(one.to.y - one.from.y, one.to.x - one.from.x) * 180) / Math.PI;
    return `translate(${one.to.x},${one.to.y}) rotate(${angle})`;
  });
  each.select('text').attr('x', (one) => one.text?.x ?? 0).attr('y', (one) => one.text?.y ?? 0)
    .text((one) => (one.text ? one.words : ''));
}
