/** The relation left of boxes in an image, as in the Python module `scene_client.image_plane`, which gives the rule. */

const MIN_OFFSET = 0.1; // minimum distance between the centres, as a part of the mean diagonal

const diagonal = ([left, high, right, low]) => Math.hypot(right - left, low - high);
const unit = (box, other) => (diagonal(box) + diagonal(other)) / 2;

function areNeighbours(box, other) {
  const across = Math.max(box[0] - other[2], other[0] - box[2], 0);
  const down = Math.max(box[1] - other[3], other[1] - box[3], 0);
  return Math.hypot(across, down) <= unit(box, other);
}

/** -1 if a box is left of its neighbour, 1 if it is right of it, 0 without a horizontal relation. */
function side(box, other) {
  const across = (box[0] + box[2]) / 2 - (other[0] + other[2]) / 2;
  const down = (box[1] + box[3]) / 2 - (other[1] + other[3]) / 2;
  if (!(Math.max(Math.abs(across), Math.abs(down)) >= MIN_OFFSET * unit(box, other))) return 0;
  return Math.abs(across) >= Math.abs(down) ? Math.sign(across) : 0;
}

/** All pairs [i, j] of neighbours where box i is left of box j. Pairs of boxes that stand first in `order` come first. */
export function leftPairs(boxes, order) {
  const pairs = [];
  order.forEach((i, rank) => {
    for (const j of order.slice(0, rank)) {
      if (!boxes[i] || !boxes[j] || !areNeighbours(boxes[i], boxes[j])) continue;
      const found = side(boxes[i], boxes[j]);
      if (found) pairs.push(found < 0 ? [i, j] : [j, i]);
    }
  });
  return pairs;
}

/** The smallest upright box around a box that is rotated by `theta` radians. */
export function uprightBox([x, y], [width, height], theta) {
  const [cos, sin] = [Math.abs(Math.cos(theta)), Math.abs(Math.sin(theta))];
  const [across, down] = [(cos * width + sin * height) / 2, (sin * width + cos * height) / 2];
  return [x - across, y - down, x + across, y + down];
}
