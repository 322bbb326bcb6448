/** The room seen from above: an SVG that d3 updates with the state. */

import { ROBOT, whereabouts } from './actions.js';
import { drawEdges } from './edge_drawing.js';
import { edgesOf, isDoubtful, judgedBy } from './edges.js';
import { drawGhosts } from './ghost_drawing.js';
import { UNKNOWN_SIZE } from './geometry.js';
import { ghostsOf, ROBOT_SIDE } from './ghosts.js';
import { createLabels } from './label_drawing.js';
import { Places } from './labels.js';
import { inWords, leftOut, reading, sizesOf } from './questions.js';
import { sizer } from './scene.js';
import { changed } from './store.js';
import { fit, gridStep, onScreen, ROUND } from './view.js';
import { searchedOf, spotsOf } from './spots.js';
import { nameOf, percent, shown } from './words.js';

const MOST_LETTERS = 28; // of a name on the board; lists show more
const [PALE, DEEP] = [12, 70]; // percent of colour in a place of the thing, by its probability
const SEEN = [
  'things', 'viewer', 'answers', 'shown', 'tab', 'selected', 'draft', 'words', 'at', 'models', 'posed',
  'right', 'line', 'covered', 'room', 'where',
];

/** Outlier entries of the shown model, by object id. */
export function outliersOf(state) {
  const answer = judgedBy(state.answers[state.shown], state);
  return new Map((answer?.outliers ?? []).map((one) => [one.object, one]));
}

export function createBoard(node, store, actions, takeGhost) {
  const svg = d3.select(node);
  const layer = (name) => svg.append('g').attr('class', name);
  const [grid, robot, objects, edges, ghosts] = ['grid', 'robot', 'objects', 'edges', 'ghosts'].map(layer);
  const labels = createLabels(svg, document.getElementById('unnamed'));
  edges.attr('aria-hidden', 'true');
  grid.attr('aria-hidden', 'true');
  let view = null;
  let dragging = false;
  let size = { width: 0, height: 0 };

  const drag = d3
    .drag()
    .container(() => node)
    .filter((event) => !event.button && !event.ctrlKey && !store.get().draft)
    .subject((event, box) => ({ x: view.across(box.y), y: view.down(box.x), again: false }))
    .on('start', (event, box) => {
      dragging = true;
      actions.select(box.id);
    })
    .on('drag', (event, box) => {
      const { x, y } = view.metres(event.x, event.y);
      actions.place(box.id, x, y, event.subject.again);
      event.subject.again = true;
    })
    .on('end', () => {
      dragging = false;
      draw(store.get());
    });

  function drawGrid() {
    const lines = [];
    const step = gridStep(view.scale);
    const from = view.metres(0, view.height);
    const to = view.metres(view.width, 0);
    for (let x = Math.ceil(from.x / step) * step; x <= to.x; x += step) lines.push({ key: `x${x}`, x1: 0, x2: view.width, y1: view.down(x), y2: view.down(x), words: view.down(x) > 16 ? `${x} m` : '', tx: 4, ty: view.down(x) - 3 });
    for (let y = Math.ceil(to.y / step) * step; y <= from.y; y += step) lines.push({ key: `y${y}`, x1: view.across(y), x2: view.across(y), y1: 0, y2: view.height, words: y ? `${y} m` : '', tx: view.across(y) + 3, ty: view.height - 4 });
    const each = grid.selectAll('g').data(lines, (line) => line.key).join((enter) => {
      const g = enter.append('g');
      g.append('line');
      g.append('text');
      return g;
    });
    each.select('line').attr('x1', (d) => d.x1).attr('x2', (d) => d.x2).attr('y1', (d) => d.y1).attr('y2', (d) => d.y2);
    each.select('text').attr('x', (d) => d.tx).attr('y', (d) => d.ty).text((d) => d.words);
  }

  function drawRobot(state) {
    const { x, y, yaw } = state.viewer;
    const size = Math.min(34, Math.max(14, ROBOT_SIDE * view.scale)) / 26;
    const g = robot.selectAll('g').data([{ id: ROBOT, x, y }]).join((enter) => {
      const added = enter.append('g').attr('tabindex', 0).attr('role', 'button');
      added.append('path').attr('class', 'sight').attr('d', 'M0,0 L-52,-90 A104,104 0 0 1 52,-90 Z');
      added.append('path').attr('class', 'body').attr('d', 'M0,-13 L10,13 L0,8 L-10,13 Z');
      return added.call(drag).on('keydown', (event) => actions.keys(event, ROBOT));
    });
    g.attr('transform', `translate(${view.across(y)},${view.down(x)}) rotate(${(-yaw * 180) / Math.PI}) scale(${size})`)
      .attr('aria-label', `Robot at x ${x}, y ${y}, rotated by ${Math.round((yaw * 180) / Math.PI)} degrees`);
  }

  function drawObjects(state, boxes, wrong) {
    const left = leftOut(state, state.shown);
    const spots = spotsOf(state);
    const searched = searchedOf(state);
    const focused = node.contains(document.activeElement) ? document.activeElement : null;
    const ordered = [...boxes].sort((a, b) => a.z - b.z || b.size.x * b.size.y - a.size.x * a.size.y);
    const each = objects.selectAll('g.object').data(ordered, (box) => box.id).join((enter) => {
      const g = enter.append('g').attr('class', 'object').attr('tabindex', 0).attr('role', 'button');
      g.append('rect').attr('class', 'box');
      g.append('title');
      g.on('focus', (_, box) => actions.select(box.id))
        .on('pointerenter', (_, box) => labels.point(box.id))
        .on('pointerleave', () => labels.point(null))
        .on('keydown', (event, box) => (event.key === 'Enter' ? openAt(event, box) : actions.keys(event, box.id)))
        .on('contextmenu', (event, box) => openAt(event, box))
        .on('dblclick', (event, box) => openAt(event, box));
      return g.call(drag);
    }).order();
    each
      .classed('selected', (box) => box.id === state.selected)
      .classed('outlier', (box) => !state.draft && Boolean(wrong.get(box.id)?.is_outlier))
      .classed('unknown', (box) => !state.draft && left.has(box.id))
      .classed('new', (box) => Boolean(state.draft?.fresh.has(box.id)))
      .classed('doubtful', (box) => !state.draft && isDoubtful(wrong.get(box.id)))
      .classed('spot', (box) => spots.has(box.id))
      .classed('searched', (box) => searched.has(box.id))
      .style('--share', (box) => (spots.has(box.id) ? `${Math.round(PALE + (DEEP - PALE) * spots.get(box.id))}%` : null))
      .classed('anchor', (box) => state.at?.object === box.id)
      .classed('loose', (box) => !state.draft && state.posed && !box.placed)
      .attr('transform', (box) => `translate(${view.across(box.y)},${view.down(box.x)}) rotate(${-box.yaw})`)
      .attr('aria-pressed', (box) => String(box.id === state.selected))
      .attr('aria-haspopup', 'menu')
      .attr('aria-label', (box) => described(box, state, boxes, wrong, spots, searched));
    each.select('rect.box')
      .attr('width', (box) => box.size.y * view.scale).attr('height', (box) => box.size.x * view.scale)
      .attr('x', (box) => (-box.size.y / 2) * view.scale).attr('y', (box) => (-box.size.x / 2) * view.scale)
      .attr('rx', (box) => (box.size === UNKNOWN_SIZE ? ROUND : Math.min(5, (Math.min(box.size.x, box.size.y) * view.scale) / 4)));
    each.select('title').text((box) => described(box, state, boxes, wrong, spots, searched));
    if (focused && focused !== document.activeElement && focused.isConnected) focused.focus();
  }

  function openAt(event, box) {
    event.preventDefault();
    const pointer = event.type === 'keydown' ? undefined : { left: event.clientX, top: event.clientY };
    actions.open(box.id, event.currentTarget, pointer);
  }

  /** The name of a box on the board: its label, with its id if another box has the label too, or how a model reads it. */
  function labelOf(box, boxes, state) {
    const read = state.draft ? [] : reading(state, state.shown, 'objects', box.label);
    if (read.length > 1) return inWords(read); // A guess names its class.
    return boxes.some(({ id, label }) => label === box.label && id !== box.id) ? nameOf(box) : box.label;
  }

  function drawLabels(state, boxes, places, wrong) {
    const half = ROBOT_SIDE / 2;
    const { x, y } = state.viewer;
    const [spots, searched] = [spotsOf(state), searchedOf(state)];
    const about = ({ id }) => [spots.has(id) ? percent(spots.get(id)) : '', searched.has(id) ? '✓' : ''].filter(Boolean);
    places.reserve({ left: view.across(y + half), right: view.across(y - half), top: view.down(x + half), bottom: view.down(x - half) });
    labels.draw(boxes.map((box) => ({
      box, words: [shown(labelOf(box, boxes, state), MOST_LETTERS), ...about(box)].join(' '),
      isWrong: !state.draft && Boolean(wrong.get(box.id)?.is_outlier), first: spots.has(box.id),
    })), view, places, state.selected);
  }

  function draw(state) {
    if (!size.width || !size.height) return;
    const boxes = (state.draft?.things ?? state.things).map(sizer(sizesOf(state, state.models[0])));
    const shown = ghostsOf(state);
    const wrong = outliersOf(state);
    if (!dragging || !view) view = fit([...boxes, ...shown], state.viewer, size.width, size.height);
    const places = new Places(size.width, size.height);
    drawGrid();
    drawRobot(state);
    drawObjects(state, boxes, wrong);
    for (const box of [...boxes, ...shown]) places.reserve(onScreen(box, view));
    drawLabels(state, boxes, places, wrong);
    drawGhosts(ghosts, shown, boxes, view, places, takeGhost);
    drawEdges(edges, edgesOf(state), boxes, view, places);
  }

  new ResizeObserver(([entry]) => {
    size = { width: entry.contentRect.width, height: entry.contentRect.height };
    draw(store.get());
  }).observe(node);
  node.addEventListener('dragover', (event) => event.preventDefault());
  node.addEventListener('drop', (event) => {
    event.preventDefault();
    const box = node.getBoundingClientRect();
    const label = event.dataTransfer.getData('text/plain');
    if (label && view) actions.add(label, view.metres(event.clientX - box.left, event.clientY - box.top));
  });
  return {
    render(state, previous) {
      if (changed(state, previous, ...SEEN)) draw(state);
    },
    focus: (id) => objects.selectAll('g.object').filter((box) => box.id === id).node()?.focus(),
  };
}

function described(box, state, boxes, wrong, spots, searched) {
  const parts = [nameOf(box), whereabouts(box.x, box.y, state.viewer)];
  const below = boxes.find(
    (other) => other.id !== box.id && box.z > 0.05 && Math.abs(other.z + other.size.z - box.z) < 0.03 &&
      Math.hypot(other.x - box.x, other.y - box.y) < Math.hypot(other.size.x, other.size.y) / 2,
  );
  if (below) parts.push(`on ${nameOf(below)}`);
  if (!state.draft && wrong.get(box.id)?.is_outlier) parts.push('does not belong here');
  if (!state.draft && isDoubtful(wrong.get(box.id))) parts.push('probably a wrong detection');
  if (spots.has(box.id)) parts.push(`possible place of ${shown(state.where.wanted)}: ${percent(spots.get(box.id))}`);
  if (searched.has(box.id)) parts.push('searched');
  return parts.join(', ');
}
