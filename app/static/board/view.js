/** Conversion of metres to pixels: x (ahead) points up, y (left) points left. */

import { halves } from './geometry.js';

const MARGIN = 0.45; // metres around the shown boxes

/**
 * A view that shows all boxes, and the robot.
 * @param {{x: number, y: number, size: object, yaw: number}[]} boxes
 */
export function fit(boxes, viewer, width, height) {
  const [ahead, aside] = boxes.length ? [1.5, 0.8] : [3.4, 1.8];
  let [low, high, right, left] = [viewer.x - 0.1, viewer.x + ahead, viewer.y - aside, viewer.y + aside];
  for (const box of boxes) {
    const half = halves(box);
    low = Math.min(low, box.x - half.x);
    high = Math.max(high, box.x + half.x);
    right = Math.min(right, box.y - half.y);
    left = Math.max(left, box.y + half.y);
  }
  const scale = Math.min(width / (left - right + 2 * MARGIN), height / (high - low + 2 * MARGIN));
  const [x, y] = [(low + high) / 2, (left + right) / 2];
  return {
    scale, width, height,
    across: (at) => width / 2 - (at - y) * scale,
    down: (at) => height / 2 - (at - x) * scale,
    metres: (px, py) => ({ x: x + (height / 2 - py) / scale, y: y + (width / 2 - px) / scale }),
  };
}

/** Radius of corners that makes a circle of any square. */
export const ROUND = 999;

const LEAST_STEP = 40; // pixels, so that the texts of grid lines do not overlap

/** Metres between grid lines: the smallest of 1, 2, 5, 10, 20 … with at least `LEAST_STEP`. */
export function gridStep(scale) {
  for (let ten = 1; ; ten *= 10) {
    const step = [1, 2, 5].find((digit) => digit * ten * scale >= LEAST_STEP);
    if (step) return step * ten;
  }
}

/** The rectangle around a box, in pixels. */
export function onScreen(box, view) {
  const a = (box.yaw * Math.PI) / 180;
  const [c, s] = [Math.abs(Math.cos(a)), Math.abs(Math.sin(a))];
  const [x, y] = [view.across(box.y), view.down(box.x)];
  const across = ((box.size.y * c + box.size.x * s) / 2) * view.scale;
  const down = ((box.size.x * c + box.size.y * s) / 2) * view.scale;
  return { left: x - across, right: x + across, top: y - down, bottom: y + down, x, y };
}
