/** A scene in the fragment of an address, which never leaves the browser. */

import { SceneError } from './scene.js';

const NAME = '#scene=';
/** Bytes of a scene as JSON: 256 objects and 4096 relations have about 300 kB. */
const MOST_BYTES = 2 ** 19;
/** Bytes unpacked in one step, which no limit can interrupt: a thousand times as many come out. */
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

/** @throws {SceneError} more than `MOST_BYTES` come out */
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
      throw new SceneError(`A scene in a link has at most ${MOST_BYTES / 1024} KiB.`);
    }
  }
  return new Blob(parts).text();
}

/** The scene of an address, null where it has none. @throws {Error} it cannot be read */
export async function fromHash(hash) {
  if (!hash.startsWith(NAME)) return null;
  const text = hash.slice(NAME.length).replaceAll('-', '+').replaceAll('_', '/');
  const packed = Uint8Array.from(atob(text), (letter) => letter.charCodeAt(0));
  return JSON.parse(await unpack(packed));
}
