/** Texts that overlap neither each other nor foreign boxes: each takes its first free place, if need be with a line to its box. */

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
  #lines = [];

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
    const rect = around(width, height);
    const others = this.#foreign(own);
    const free = centres.filter((centre) => this.#isClear(rect(centre)));
    const centre = free.find((one) => !others.some((other) => meet(rect(one), other)))
      ?? free.find((one) => own.some((box) => holds(box, rect(one)))) ?? null;
    if (centre) this.#texts.push(rect(centre));
    return centre;
  }

  /**
   * Takes the first centre where a text meets neither a text nor a reserved rectangle, and a line leads from the text to its
   * box without crossing a text or another line. Returns the centre and the line, or null.
   */
  join(width, height, centres, box) {
    const rect = around(width, height);
    const others = this.#foreign([box]);
    for (const centre of centres) {
      const text = rect(centre);
      if (!this.#isClear(text) || others.some((other) => meet(text, other)) || this.#lines.some((other) => crosses(other, text))) continue;
      const end = { x: Math.min(Math.max(box.x, text.left), text.right), y: Math.min(Math.max(box.y, text.top), text.bottom) };
      const line = [border(box, end), end];
      if (this.#texts.some((other) => crosses(line, other)) || this.#lines.some((other) => cross(line, other))) continue;
      this.#texts.push(text);
      this.#lines.push(line);
      return { ...centre, line };
    }
    return null;
  }

  #foreign(own) {
    return this.#boxes.filter((box) => !own.some((one) => holds(box, one)));
  }

  #isClear(rect) {
    return this.#inside(rect) && !this.#texts.some((other) => meet(rect, other));
  }

  #inside(box) {
    return box.left >= 0 && box.top >= 0 && box.right <= this.width && box.bottom <= this.height;
  }
}

const around = (width, height) => ({ x, y }) => ({
  left: x - width / 2, right: x + width / 2, top: y - height / 2, bottom: y + height / 2,
});
const holds = (a, b) => a.left <= b.left && b.right <= a.right && a.top <= b.top && b.bottom <= a.bottom;
const meet = (a, b) => a.left < b.right && b.left < a.right && a.top < b.bottom && b.top < a.bottom;

const side = ([a, b], p) => Math.sign((b.x - a.x) * (p.y - a.y) - (b.y - a.y) * (p.x - a.x));
/** Whether two lines cross. */
const cross = (one, other) => side(one, other[0]) !== side(one, other[1]) && side(other, one[0]) !== side(other, one[1]);

/** Whether a line meets a rectangle. */
function crosses(line, { left, right, top, bottom }) {
  const [a, b] = line;
  if (Math.max(a.x, b.x) < left || Math.min(a.x, b.x) > right || Math.max(a.y, b.y) < top || Math.min(a.y, b.y) > bottom) return false;
  const corners = [{ x: left, y: top }, { x: right, y: top }, { x: right, y: bottom }, { x: left, y: bottom }];
  return new Set(corners.map((corner) => side(line, corner))).size > 1;
}

const SMALL = 24; // pixels; a line ends at the centre of a smaller box

/** The point of a box where a line from another point ends. */
function border({ x, y, left, right, top, bottom }, towards) {
  const [dx, dy] = [towards.x - x, towards.y - y];
  if (Math.max(right - left, bottom - top) < SMALL) return { x, y };
  const part = Math.min(1, (right - left) / 2 / Math.abs(dx), (bottom - top) / 2 / Math.abs(dy));
  return { x: x + dx * part, y: y + dy * part };
}

const [NEAREST, FURTHEST, RING, STEPS] = [20, 140, 15, 20]; // pixels between box and text; candidates of a ring

/** Places around a box for a text with a line, nearest first. */
export function joinedPlaces({ left, right, top, bottom, x, y }, width) {
  const centres = [];
  for (let far = NEAREST; far <= FURTHEST; far += RING) {
    for (let step = 0; step < STEPS; step += 1) {
      const angle = (2 * Math.PI * (step + 0.5)) / STEPS;
      centres.push({
        x: x + ((right - left + width) / 2 + far) * Math.cos(angle), y: y + ((bottom - top + LINE) / 2 + far) * Math.sin(angle),
      });
    }
  }
  return centres;
}

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
