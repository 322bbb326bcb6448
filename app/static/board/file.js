/** The dialog with the scene as text, to copy it, store it in a file or share it as a link. */

import { call, ProblemError, UnreachableError } from './api.js';
import { copy } from './dom.js';
import { asRequest, ownScenes } from './importing.js';
import { countOf } from './notes.js';
import { linesOf } from './records.js';
import { sizesOf } from './questions.js';
import { SceneError, toScene } from './scene.js';
import { toHash } from './share.js';
import { shown } from './words.js';

const MOST_BYTES = 64 * 2 ** 20; // of a file
const MOST_SHOWN = 2 ** 20; // bytes; a browser needs a minute to show a text of 50 MB

/**
 * @typedef {{name: string, scene: object, notes?: object[]}} Found a scene of a text. Only scenes that the service has read have notes
 * @param {(scene: object, notes: object[], line: object | undefined) => void} put puts a scene on the board; throws SceneError
 * @param {(scenes: Found[], index: number, isNew: boolean) => void} whenPlaced gets the scenes of a text and the number of that on the board
 * @returns {{place: (index: number) => void}} puts another scene of the opened text on the board
 */
export function fileDialog(store, records, recorded, put, say, whenPlaced) {
  const get = (id) => document.getElementById(id);
  const [dialog, area, error, done, which, map, names] =
    ['file', 'json', 'json-error', 'share-done', 'which', 'label-map', 'label-names'].map(get);
  const scene = () => toScene(store.get(), sizesOf(store.get(), store.get().models[0]));
  let found = null; // the scenes of the text; null before the service has read it
  let name = ''; // of the file in the text area; empty for a pasted text
  let opened = {}; // scenes and name of the text whose scene was put on the board last
  let hidden = ''; // text of a large file, which the text area does not show
  const source = () => hidden || area.value;
  const chosen = () => Math.min(found.length, Math.max(1, Number(which.value))) - 1;

  /** Finds the scenes of the text, or says that the text goes to the service. */
  function look() {
    let travels = false;
    found = null;
    error.textContent = '';
    try {
      found = ownScenes(source());
      travels = !found;
    } catch (problem) {
      // The button “Put on the board” shows the error.
      if (!(problem instanceof SceneError)) throw problem;
    }
    get('travels').hidden = !travels;
    listScenes();
  }

  /** Lets the user choose a scene if the text has several: lines, images, frames or rooms. */
  function listScenes() {
    which.max = found?.length;
    which.value = 1;
    which.parentElement.hidden = !(found?.length > 1);
    nameScene();
  }

  function nameScene() {
    get('scenes').textContent = found ? `of ${found.length}: ${shown(found[chosen()].name)}` : '';
  }

  /** The scenes of a text in another format than that of requests. The service reads it and stores nothing. */
  async function readByService(text) {
    const labels = map.value === 'own' ? names.value : map.value;
    const { scenes, notes } = await call('scenes', { text, name: name.slice(-255) || 'text', ...(labels && { label_map: labels }) });
    const about = (index) => notes.filter((note) => note.scene === index);
    return scenes.map((one, index) => ({ ...one, notes: [...about(null), ...about(index)] }));
  }

  /** Shows the buttons of the confirmed scenes if there are any. */
  function listRecords() {
    get('download-scenes').hidden = !records.count();
    get('download-scenes').textContent = `Download ${records.name()} (${records.count()} confirmed)`;
    get('forget-scenes').hidden = !records.kept();
    get('forget-scenes').textContent = `Remove ${records.kept()} confirmed from this browser`;
    if (records.others()) done.textContent = `Confirmed scenes of other files: ${records.others()}. Open such a file to download its scenes.`;
  }

  function show(text, file = null) {
    const isLarge = file && file.size > MOST_SHOWN;
    name = file?.name ?? '';
    hidden = isLarge ? text : '';
    area.value = isLarge ? '' : text;
    done.textContent = isLarge ? `${shown(file.name)} is open. It is too large to be shown here.` : '';
    look();
  }

  area.addEventListener('input', () => {
    hidden = '';
    done.textContent = '';
    look();
  });
  which.addEventListener('input', nameScene);
  map.addEventListener('change', () => {
    names.parentElement.hidden = map.value !== 'own';
    look();
  });
  names.addEventListener('input', look);
  get('open-file').addEventListener('click', () => {
    show(JSON.stringify(scene(), null, 1));
    listRecords();
    dialog.showModal();
    area.focus();
    area.setSelectionRange(0, 0);
  });
  get('close-file').addEventListener('click', () => dialog.close());
  get('import').addEventListener('click', async ({ target }) => {
    target.disabled = true; // a second click would send the file twice
    try {
      const text = source();
      const scenes = found ?? ownScenes(text) ?? await readByService(text);
      if (text !== source()) return; // the user has opened another file in the meantime
      const isNew = !found;
      found = scenes;
      if (isNew && found.length > 1) {
        listScenes();
        done.textContent = `The file has ${found.length} scenes: choose one.`;
        which.focus();
        return;
      }
      place(chosen(), { scenes, name: name || 'scenes.jsonl' });
      dialog.close();
    } catch (problem) {
      if (!(problem instanceof SceneError || problem instanceof ProblemError || problem instanceof UnreachableError)) throw problem;
      error.textContent = problem.problem?.detail ?? problem.message;
    } finally {
      target.disabled = false;
    }
  });
  /** Puts a scene of a text on the board. Throws SceneError. */
  function place(index, text) {
    const { scene: given, notes } = text.scenes[index];
    if (notes && !given.objects.length) {
      throw new SceneError(`The file has no object for a scene: ${notes[0]?.detail ?? 'it lists no detection with a class'}.`);
    }
    const lines = notes ? [] : linesOf(text.scenes, text.name);
    const line = lines.length ? records.open(lines, text.name)[index] : undefined;
    put(asRequest(line ?? given), notes ?? [], line);
    whenPlaced(text.scenes, index, opened !== text);
    opened = text;
    recorded.open(lines, index);
    const count = text.scenes.length;
    say(`${count > 1 ? `Scene ${index + 1} of ${count}` : 'The scene'} is on the board. ${countOf(notes ?? [])}`.trim());
  }
  get('download').addEventListener('click', () => save(source(), 'scene.json'));
  get('download-scenes').addEventListener('click', () => save(records.text(), records.name()));
  get('forget-scenes').addEventListener('click', () => {
    records.clear();
    listRecords();
    done.textContent = 'This browser keeps no confirmed scene.';
    get('download').focus();
  });
  get('upload').addEventListener('change', async ({ target }) => {
    const [file] = target.files;
    if (file && file.size <= MOST_BYTES) show(await file.text(), file);
    else if (file) error.textContent = `The file is too large: it has more than ${MOST_BYTES / 2 ** 20} MiB.`;
    target.value = '';
  });
  get('share').addEventListener('click', async () => {
    history.replaceState(null, '', await toHash(scene()));
    await copy(location.href);
    done.textContent = 'The link is copied. It contains the whole scene, and browsers do not send this part to a server.';
  });
  return { place: (index) => place(index, opened) };
}

/** Saves a text as a file. */
function save(text, name) {
  const link = document.createElement('a');
  link.href = URL.createObjectURL(new Blob([text], { type: 'application/json' }));
  link.download = name;
  link.click();
  URL.revokeObjectURL(link.href);
}
