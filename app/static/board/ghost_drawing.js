/** Suggestions as dashed boxes ("ghosts") with their probability. */

import { UNKNOWN_SIZE } from './geometry.js';
import { labelPlaces, widthOf } from './labels.js';
import { SHIFTED } from './ghosts.js';
import { onScreen, ROUND } from './view.js';
import { namesOf, percent, SPOKEN } from './words.js';

const FONT = '500 12px system-ui, sans-serif';

const spokenGhost = ({ label, probability, placement, shifted }, name) =>
  `${label}, ${percent(probability)}, ${SPOKEN[placement.relation]} ${name(placement.object)}${shifted ? `, ${SHIFTED}` : ''}`;

export function drawGhosts(layer, ghosts, boxes, view, places, take) {
  const name = namesOf(boxes);
  const texts = new Map();
  for (const ghost of ghosts) {
    const width = widthOf(ghost.label, FONT) + 8;
    const rect = onScreen(ghost, view);
    texts.set(ghost.id, places.take(width, 16, labelPlaces(rect, width), [rect]));
  }
  const each = layer.selectAll('g.ghost').data(ghosts, (ghost) => ghost.id).join((enter) => {
    const g = enter.append('g').attr('class', 'ghost').attr('tabindex', 0).attr('role', 'button');
    g.append('rect');
    g.append('text');
    g.append('title');
    return g.on('click', ({ detail }, ghost) => detail < 2 && take(ghost)).on('keydown', (event, ghost) => {
      if (event.key !== 'Enter' && event.key !== ' ') return;
      event.preventDefault();
      take(ghost);
    });
  });
  each.attr('aria-label', (ghost) => `Suggested: ${spokenGhost(ghost, name)}. Put it there`);
  each.select('title').text((ghost) => `${spokenGhost(ghost, name)}: click to put it there`);
  each.select('rect')
    .attr('rx', (ghost) => (ghost.size === UNKNOWN_SIZE ? ROUND : 4))
    .attr('width', (ghost) => ghost.size.y * view.scale).attr('height', (ghost) => ghost.size.x * view.scale)
    .attr('x', (ghost) => view.across(ghost.y) - (ghost.size.y / 2) * view.scale)
    .attr('y', (ghost) => view.down(ghost.x) - (ghost.size.x / 2) * view.scale);
  each.select('text')
    .attr('x', (ghost) => texts.get(ghost.id)?.x ?? 0).attr('y', (ghost) => texts.get(ghost.id)?.y ?? 0)
    .text((ghost) => (texts.get(ghost.id) ? ghost.label : ''));
}
