/**
 * Parses XML without entities of its own. DOMParser is unsuitable: it reports an error as a document
 * with inline styles, which the content security policy of the page forbids.
 */

const TOKEN = /<!--[^]*?-->|<\?[^]*?\?>|<!\[CDATA\[[^]*?\]\]>|<(\/?)([\w:.-]+)((?:\s+[\w:.-]+\s*=\s*(?:"[^"<]*"|'[^'<]*'))*)\s*(\/?)>|[^<]+/gy;
const ATTRIBUTE = /([\w:.-]+)\s*=\s*(?:"([^"]*)"|'([^']*)')/g;
const NAMED = { lt: '<', gt: '>', amp: '&', quot: '"', apos: "'" };

export class XmlElement {
  constructor(tag, attributes) {
    this.tag = tag;
    this.attributes = attributes;
    this.children = [];
  }

  /** All elements with a tag below this element, in the order of the document. */
  all(tag) {
    return this.children.flatMap((child) => [...(child.tag === tag ? [child] : []), ...child.all(tag)]);
  }
}

/** @returns {XmlElement} the root @throws {SyntaxError} */
export function parseXml(text) {
  const document = new XmlElement('', new Map());
  const open = [document];
  let end = 0;
  for (const [token, closing, tag, attributes, isEmpty] of text.matchAll(TOKEN)) {
    end += token.length;
    if (!tag) {
      if (open.length === 1 && token[0] !== '<' && token.trim()) break;
    } else if (closing) {
      if (open.length === 1 || open.pop().tag !== tag) throw new SyntaxError(`</${tag}> has no start`);
    } else {
      const element = new XmlElement(tag, attributesOf(attributes));
      open.at(-1).children.push(element);
      if (!isEmpty) open.push(element);
    }
  }
  if (end < text.length) throw new SyntaxError(`invalid at character ${end}`);
  if (open.length > 1) throw new SyntaxError(`<${open.at(-1).tag}> has no end`);
  if (document.children.length !== 1) throw new SyntaxError('no single root');
  return document.children[0];
}

function attributesOf(text) {
  const pairs = [...text.matchAll(ATTRIBUTE)].map(([, name, double, single]) => [name, unescaped(double ?? single)]);
  const attributes = new Map(pairs);
  if (attributes.size < pairs.length) throw new SyntaxError('an attribute is there twice');
  return attributes;
}

function unescaped(value) {
  return value.replace(/&(?:#(\d+)|#x([\da-fA-F]+)|(\w+));|&/g, (_, decimal, hex, name) => {
    if (name) return NAMED[name] ?? wrong();
    const code = decimal ? Number(decimal) : hex ? parseInt(hex, 16) : NaN;
    return code > 0 && code <= 0x10ffff ? String.fromCodePoint(code) : wrong();
  });
}

function wrong() {
  throw new SyntaxError('unknown entity');
}
