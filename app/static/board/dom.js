/** Helpers to create and update elements. */

/**
 * @param {string} tag
 * @param {Record<string, unknown>} [properties] `class`, `on…` and attributes
 * @param {...(Node | string | null)} children
 */
export function el(tag, properties = {}, ...children) {
  const node = document.createElement(tag);
  for (const [name, value] of Object.entries(properties)) {
    if (value === null || value === undefined || value === false) continue;
    if (name.startsWith('on')) node.addEventListener(name.slice(2), value);
    else node.setAttribute(name, value === true ? '' : value);
  }
  node.append(...children.filter((child) => child !== null));
  return node;
}

/** Replaces children. The focus stays on the element with the same `data-key`, or moves to the first one. */
export function redraw(parent, children) {
  const key = parent.contains(document.activeElement) ? document.activeElement.dataset.key : null;
  parent.replaceChildren(...children);
  if (!key) return;
  const same = parent.querySelector(`[data-key="${CSS.escape(key)}"]`);
  (same ?? parent.querySelector('[data-key]'))?.focus({ preventScroll: true });
}

/** Copies a text. On pages without https, which lack the clipboard API, it uses a selection. */
export async function copy(text) {
  if (navigator.clipboard) {
    await navigator.clipboard.writeText(text);
    return;
  }
  const area = el('textarea', { 'aria-hidden': 'true', class: 'unseen' });
  area.value = text;
  (document.querySelector('dialog[open]') ?? document.body).append(area);
  area.select();
  document.execCommand('copy');
  area.remove();
}

/** A bar that shows a probability, with a tick at its former value. */
export function bar(probability, kind = '', was = null) {
  const svg = document.createElementNS('http://www.w3.org/2000/svg', 'svg');
  svg.setAttribute('class', `bar ${kind}`);
  svg.setAttribute('aria-hidden', 'true');
  const rect = document.createElementNS('http://www.w3.org/2000/svg', 'rect');
  rect.setAttribute('width', `${100 * probability}%`);
  rect.setAttribute('height', '100%');
  svg.append(rect);
  if (was !== null) {
    const tick = rect.cloneNode();
    tick.setAttribute('class', 'was');
    tick.setAttribute('x', `${100 * was}%`);
    tick.setAttribute('width', 2);
    svg.append(tick);
  }
  return svg;
}
