/** The dialog with the scene as text, to copy it, store it in a file or share it as a link. */

import { copy } from './dom.js';
import { scenesIn } from './importing.js';
import { linesIn } from './records.js';
import { sizesOf } from './questions.js';
import { SceneError, toScene } from './scene.js';
import { toHash } from './share.js';

/** @param {(scene: object, line: object | undefined) => void} put puts a scene on the board; throws SceneError */
export function fileDialog(store, records, put, say) {
  const get = (id) => document.getElementById(id);
  const [dialog, area, error, done, which] = ['file', 'json', 'json-error', 'share-done', 'which'].map(get);
  const scene = () => toScene(store.get(), sizesOf(store.get(), store.get().models[0]));

  /** Lets the user choose a scene if the text has several, one a line. */
  function count() {
    let scenes = [];
    try {
      scenes = scenesIn(area.value);
    } catch {
      // The button “Put on the board” shows the error.
    }
    which.max = scenes.length;
    which.value = 1;
    which.parentElement.hidden = scenes.length < 2;
    get('scenes').textContent = `of ${scenes.length}`;
  }

  /** Shows the buttons of the confirmed scenes if there are any. */
  function listRecords() {
    get('download-scenes').hidden = !records.count();
    get('download-scenes').textContent = `Download scenes.jsonl (${records.count()} confirmed)`;
    get('forget-scenes').hidden = !records.kept();
    get('forget-scenes').textContent = `Remove ${records.kept()} confirmed from this browser`;
  }

  area.addEventListener('input', count);
  get('open-file').addEventListener('click', () => {
    area.value = JSON.stringify(scene(), null, 1);
    error.textContent = '';
    done.textContent = '';
    count();
    listRecords();
    dialog.showModal();
    area.focus();
  });
  get('close-file').addEventListener('click', () => dialog.close());
  get('import').addEventListener('click', () => {
    try {
      const scenes = scenesIn(area.value);
      const index = Math.min(scenes.length, Math.max(1, Number(which.value))) - 1;
      const found = linesIn(area.value);
      const line = found.length ? records.open(found)[index] : undefined;
      put(line ? scenesIn(JSON.stringify(line))[0] : scenes[index], line);
      dialog.close();
      say('The scene is on the board.');
    } catch (problem) {
      if (!(problem instanceof SceneError || problem instanceof SyntaxError)) throw problem;
      error.textContent = problem instanceof SyntaxError ? `This is neither JSON nor a list of labels: ${problem.message}.` : problem.message;
    }
  });
  get('download').addEventListener('click', () => save(area.value, 'scene.json'));
  get('download-scenes').addEventListener('click', () => save(records.text(), 'scenes.jsonl'));
  get('forget-scenes').addEventListener('click', () => {
    records.clear();
    listRecords();
    done.textContent = 'This browser keeps no confirmed scene.';
    get('download').focus();
  });
  get('upload').addEventListener('change', async ({ target }) => {
    if (target.files[0]) area.value = await target.files[0].text();
    target.value = '';
    count();
  });
  get('share').addEventListener('click', async () => {
    history.replaceState(null, '', await toHash(scene()));
    await copy(location.href);
    done.textContent = 'The link is copied. It contains the whole scene, and browsers do not send this part to a server.';
  });
}

/** Saves a text as a file. */
function save(text, name) {
  const link = document.createElement('a');
  link.href = URL.createObjectURL(new Blob([text], { type: 'application/json' }));
  link.download = name;
  link.click();
  URL.revokeObjectURL(link.href);
}
