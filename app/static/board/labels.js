/** Texts that overlap neither each other nor foreign boxes: each takes its first free place. */

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

  /** Keeps a rectangle free of texts, except of texts inside their own box. */
  reserve(box) {
    this.#boxes.push(box);
  }

  /**
   * Takes the first centre where a text of this size meets neither a text nor a reserved rectangle, else the first inside
   * its own box without a text, else null.
   * A text on a foreign box would name the wrong object.
   * @param {{x: number, y: number}[]} centres best first
   * @param {object[]} own the boxes of the text. A text may cover the rectangles around its boxes, such as a support.
   */
  take(width, height, centres, own) {
    const around = ({ x, y }) => ({
      left: x - width / 2, right: x + width / 2, top: y - height / 2, bottom: y + height / 2,
    });
    const clear = (centre) => this.#inside(around(centre)) && !this.#texts.some((other) => meet(around(centre), other));
    const others = this.#boxes.filter((box) => !own.some((one) => holds(box, one)));
    const free = centres.filter(clear);
    const centre = free.find((one) => !others.some((other) => meet(around(one), other)))
      ?? free.find((one) => own.some((box) => holds(box, around(one)))) ?? null;
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
