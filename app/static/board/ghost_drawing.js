/** Suggestions as dashed boxes ("ghosts") with their probability. */

import { overlap, UNKNOWN_SIZE } from './geometry.js';
import { labelPlaces, widthOf } from './labels.js';
import { onScreen, ROUND } from './view.js';
import { percent, SPOKEN } from './words.js';

const FONT = '500 12px system-ui, sans-serif';

const spokenGhost = ({ label, probability, placement }) =>
  `${label}, ${percent(probability)}, ${SPOKEN[placement.relation]} ${placement.object}`;

export function drawGhosts(layer, ghosts, boxes, view, places, take) {
  const words = (ghost) => `${ghost.label} ${percent(ghost.probability)}`;
  const texts = new Map();
  for (const box of boxes) if (!ghosts.some((ghost) => overlap(ghost, box))) places.reserve(onScreen(box, view));
  for (const ghost of ghosts) {
    const width = widthOf(ghost.label, FONT) + 8;
    texts.set(ghost.id, places.take(width, 16, labelPlaces(onScreen(ghost, view), width)));
  }
  const each = layer.selectAll('g.ghost').data(ghosts, (ghost) => ghost.id).join((enter) => {
    const g = enter.append('g').attr('class', 'ghost').attr('tabindex', 0).attr('role', 'button');
    g.append('rect');
    g.append('text');
    g.append('title');
    return g.on('click', (_, ghost) => take(ghost)).on('keydown', (event, ghost) => {
      if (event.key !== 'Enter' && event.key !== ' ') return;
      event.preventDefault();
      take(ghost);
    });
  });
  each.attr('aria-label', (ghost) => `Suggested: ${spokenGhost(ghost)}. Put it there`);
  each.select('title').text((ghost) => `${spokenGhost(ghost)}: click to put it there`);
  each.select('rect')
    .attr('rx', (ghost) => (ghost.size === UNKNOWN_SIZE ? ROUND : 4))
    .attr('width', (ghost) => ghost.size.y * view.scale).attr('height', (ghost) => ghost.size.x * view.scale)
    .attr('x', (ghost) => view.across(ghost.y) - (ghost.size.y / 2) * view.scale)
    .attr('y', (ghost) => view.down(ghost.x) - (ghost.size.x / 2) * view.scale);
  each.select('text')
    .attr('x', (ghost) => texts.get(ghost.id)?.x ?? 0).attr('y', (ghost) => texts.get(ghost.id)?.y ?? 0)
    .text((ghost) => (texts.get(ghost.id) ? ghost.label : ''));
}
