/** The dialog with the scene as text, to copy it, store it in a file or share it as a link. */

import { copy } from './dom.js';
import { sizesOf } from './questions.js';
import { SceneError, toScene } from './scene.js';
import { toHash } from './share.js';

/** @param {(scene: object) => string} put puts a scene on the board and returns a note; throws SceneError */
export function fileDialog(store, put, say) {
  const get = (id) => document.getElementById(id);
  const [dialog, area, error, done] = ['file', 'json', 'json-error', 'share-done'].map(get);
  const scene = () => toScene(store.get(), sizesOf(store.get(), store.get().models[0]));

  get('open-file').addEventListener('click', () => {
    area.value = JSON.stringify(scene(), null, 1);
    error.textContent = '';
    done.textContent = '';
    dialog.showModal();
    area.focus();
  });
  get('close-file').addEventListener('click', () => dialog.close());
  get('import').addEventListener('click', () => {
    try {
      const left = put(JSON.parse(area.value));
      dialog.close();
      say(`The scene is on the board. ${left}`);
    } catch (problem) {
      if (!(problem instanceof SceneError || problem instanceof SyntaxError)) throw problem;
      error.textContent = problem instanceof SyntaxError ? `This is not JSON: ${problem.message}.` : problem.message;
    }
  });
  get('download').addEventListener('click', () => {
    const link = document.createElement('a');
    link.href = URL.createObjectURL(new Blob([area.value], { type: 'application/json' }));
    link.download = 'scene.json';
    link.click();
    URL.revokeObjectURL(link.href);
  });
  get('upload').addEventListener('change', async ({ target }) => {
    if (target.files[0]) area.value = await target.files[0].text();
    target.value = '';
  });
  get('share').addEventListener('click', async () => {
    history.replaceState(null, '', await toHash(scene()));
    await copy(location.href);
    done.textContent = 'The link is copied. It contains the whole scene, and browsers do not send this part to a server.';
  });
}
