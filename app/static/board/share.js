/** A scene in the fragment of a URL, which browsers do not send to a server. */

import { SceneError } from './scene.js';

const NAME = '#scene=';
/** Maximum size in bytes of a scene in JSON; 256 objects and 4096 relations take about 300 kB. */
const MOST_BYTES = 2 ** 19;
/** Bytes unpacked in one step. They can expand by a factor of 1000 before the size is checked. */
const STEP = 1024;

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

/** @throws {SceneError} the unpacked scene has more than `MOST_BYTES` */
async function unpack(packed) {
  let at = 0;
  const steps = new ReadableStream({
    pull(controller) {
      if (at < packed.length) controller.enqueue(packed.subarray(at, (at += STEP)));
      else controller.close();
    },
  });
  const reader = steps.pipeThrough(new DecompressionStream('deflate-raw')).getReader();
  const parts = [];
  let size = 0;
  for (let part = await reader.read(); !part.done; part = await reader.read()) {
    parts.push(part.value);
    size += part.value.length;
    if (size > MOST_BYTES) {
      reader.cancel().catch(() => {});
      throw new SceneError(`A scene in a link can have at most ${MOST_BYTES / 1024} KiB.`);
    }
  }
  return new Blob(parts).text();
}

/** The scene in a URL fragment, or null without a scene. @throws {Error} the scene is invalid */
export async function fromHash(hash) {
  if (!hash.startsWith(NAME)) return null;
  const text = hash.slice(NAME.length).replaceAll('-', '+').replaceAll('_', '/');
  const packed = Uint8Array.from(atob(text), (letter) => letter.charCodeAt(0));
  return JSON.parse(await unpack(packed));
}
