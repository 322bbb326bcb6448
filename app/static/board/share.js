/** A scene in the fragment of an address, which never leaves the browser. */

const NAME = '#scene=';

async function through(bytes, stream) {
  return new Uint8Array(await new Response(new Blob([bytes]).stream().pipeThrough(stream)).arrayBuffer());
}

/** @param {object} scene */
export async function toHash(scene) {
  const bytes = new TextEncoder().encode(JSON.stringify(scene));
  const packed = await through(bytes, new CompressionStream('deflate-raw'));
  const text = btoa(Array.from(packed, (byte) => String.fromCharCode(byte)).join(''));
  return NAME + text.replaceAll('+', '-').replaceAll('/', '_').replace(/=+$/, '');
}

/** The scene of an address, null where it has none. @throws {Error} it cannot be read */
export async function fromHash(hash) {
  if (!hash.startsWith(NAME)) return null;
  const text = hash.slice(NAME.length).replaceAll('-', '+').replaceAll('_', '/');
  const packed = Uint8Array.from(atob(text), (letter) => letter.charCodeAt(0));
  return JSON.parse(new TextDecoder().decode(await through(packed, new DecompressionStream('deflate-raw'))));
}
