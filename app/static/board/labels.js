/** Texts that do not overlap: each takes the place that covers the fewest boxes. */

/** Height of a label in pixels. */
export const LINE = 17;

const canvas = document.createElement('canvas').getContext('2d');
const widths = new Map();

/** Width of a text in pixels. */
export function widthOf(text, font) {
  const key = `${font}/${text}`;
  if (!widths.has(key)) {
    canvas.font = font;
    widths.set(key, canvas.measureText(text).width);
  }
  return widths.get(key);
}

export class Places {
  #texts = [];
  #boxes = [];

  constructor(width, height) {
    this.width = width;
    this.height = height;
  }

  /** Keeps a rectangle free of texts, if they have another place. */
  reserve(box) {
    this.#boxes.push(box);
  }

  /**
   * Takes a centre where a text of this size meets no other text and the fewest reserved rectangles; null if there is none.
   * @param {{x: number, y: number}[]} centres best first
   * @param {object} [own] the box of the text. A text may cover the rectangles around its box, such as the support.
   */
  take(width, height, centres, own) {
    const around = ({ x, y }) => ({
      left: x - width / 2, right: x + width / 2, top: y - height / 2, bottom: y + height / 2,
    });
    const clear = (centre) => this.#inside(around(centre)) && !this.#texts.some((other) => meet(around(centre), other));
    const free = centres.filter(clear);
    const others = this.#boxes.filter((box) => !own || !holds(box, own));
    const covered = (one) => others.filter((other) => meet(around(one), other)).length;
    const [[, centre] = [0, null]] = free.map((one) => [covered(one), one]).sort(([a], [b]) => a - b);
    if (centre) this.#texts.push(around(centre));
    return centre;
  }

  #inside(box) {
    return box.left >= 0 && box.top >= 0 && box.right <= this.width && box.bottom <= this.height;
  }
}

const holds = (a, b) => a.left <= b.left && b.right <= a.right && a.top <= b.top && b.bottom <= a.bottom;
const meet = (a, b) => a.left < b.right && b.left < a.right && a.top < b.bottom && b.top < a.bottom;

/** Possible places for the text of a box, best first. */
export function labelPlaces({ left, right, top, bottom, x, y }, width) {
  const inside = right - left >= width && bottom - top >= LINE
    ? [{ x, y }, { x, y: bottom - LINE / 2 - 1 }, { x, y: top + LINE / 2 + 1 }]
    : [];
  return [
    ...inside,
    { x, y: bottom + LINE / 2 + 1 }, { x, y: top - LINE / 2 - 1 },
    { x: right + width / 2 + 2, y }, { x: left - width / 2 - 2, y },
    { x, y: bottom + 1.5 * LINE }, { x, y: top - 1.5 * LINE },
  ];
}
