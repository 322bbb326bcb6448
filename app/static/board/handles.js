/** Two handles that resize and rotate the selected object. The form does both by keyboard. */

import { radians, round } from './geometry.js';

const STEP = 15; // degrees, while snapping

export function handles(store, actions, view, busy) {
  function local(event, box) {
    const at = view().metres(event.x, event.y);
    const a = radians(box.yaw);
    const [dx, dy] = [at.x - box.x, at.y - box.y];
    return { along: dx * Math.cos(a) + dy * Math.sin(a), across: dy * Math.cos(a) - dx * Math.sin(a), dx, dy };
  }

  function resize(event, box, again) {
    const { along, across } = local(event, box);
    const extent = (half) => Math.max(0.02, actions.snapped(2 * Math.abs(half)));
    actions.change(box.id, { size: { ...box.size, x: extent(along), y: extent(across) } }, again);
  }

  function turn(event, box, again) {
    const { dx, dy } = local(event, box);
    const degrees = (Math.atan2(dy, dx) * 180) / Math.PI;
    const yaw = store.get().snap ? Math.round(degrees / STEP) * STEP : degrees;
    actions.change(box.id, { yaw: round((yaw + 360) % 360, 2) }, again);
  }

  const dragged = (act) => d3.drag()
    .container(() => document.getElementById('board'))
    .subject((event) => ({ x: event.x, y: event.y, again: false }))
    .on('start', () => busy(true))
    .on('drag', (event, box) => {
      act(event, box, event.subject.again);
      event.subject.again = true;
    })
    .on('end', () => {
      busy(false);
      store.set({ things: [...store.get().things] });
    });

  const [resizing, turning] = [dragged(resize), dragged(turn)];
  return (layer, selected) => {
    const group = layer.selectAll('g.handles').data(selected ? [selected] : [], (box) => box.id).join((enter) => {
      const g = enter.append('g').attr('class', 'handles').attr('aria-hidden', 'true');
      g.append('line');
      g.append('circle').attr('class', 'resize').attr('r', 6);
      g.append('circle').attr('class', 'turn').attr('r', 6);
      return g;
    }).raise();
    if (!selected) return;
    const { scale, across, down } = view();
    const [w, h] = [(selected.size.y / 2) * scale, (selected.size.x / 2) * scale];
    group.attr('transform', `translate(${across(selected.y)},${down(selected.x)}) rotate(${-selected.yaw})`);
    group.select('line').attr('y1', -h).attr('y2', -h - 20);
    group.select('.resize').attr('cx', w).attr('cy', h).datum(selected).call(resizing);
    group.select('.turn').attr('cy', -h - 20).datum(selected).call(turning);
  };
}
