/** The dialog with the scene as text, to copy it, store it in a file or share it as a link. */

import { labelsOf } from './class_ids.js';
import { copy } from './dom.js';
import { MOST_BYTES, scenesIn } from './importing.js';
import { linesIn } from './records.js';
import { sizesOf } from './questions.js';
import { SceneError, toScene } from './scene.js';
import { toHash } from './share.js';

const SOME = 3; // notes that the page shows
const MOST_SHOWN = 2 ** 20; // bytes; a browser needs a minute to show a text of 50 MB

/**
 * @param {(scene: object, notes: string, line: object | undefined) => void} put puts a scene on the board; throws SceneError
 * @returns {{place: (index: number) => void}} puts another scene of the opened text on the board
 */
export function fileDialog(store, records, recorded, put, say) {
  const get = (id) => document.getElementById(id);
  const [dialog, area, error, done, which, map, names] =
    ['file', 'json', 'json-error', 'share-done', 'which', 'label-map', 'label-names'].map(get);
  const scene = () => toScene(store.get(), sizesOf(store.get(), store.get().models[0]));
  const chosen = (count) => Math.min(count, Math.max(1, Number(which.value))) - 1;
  let found = [];
  let name = ''; // of the file in the text area
  let opened = []; // text and name of the file whose scene was put on the board last
  let hidden = ''; // text of a large file, which the text area does not show
  const source = () => hidden || area.value;

  /** Lets the user choose a scene if the text has several: lines, images, frames or rooms. */
  function count() {
    found = [];
    try {
      found = scenesIn(source()).names;
    } catch (problem) {
      // The button “Put on the board” shows the error.
      if (!(problem instanceof SceneError)) throw problem;
    }
    which.max = found.length;
    which.value = 1;
    which.parentElement.hidden = found.length < 2;
    nameScene();
  }

  function nameScene() {
    get('scenes').textContent = `of ${found.length}: ${found[chosen(found.length)] ?? ''}`;
  }

  /** The text of the notes on values that the scene leaves out. */
  function inWords(notes) {
    const words = notes.slice(0, SOME).map(([index, , reason]) => (index === null ? reason : `detection ${index}: ${reason}`));
    return words.length ? `The file was read with notes: ${words.join('; ')}${notes.length > SOME ? `; and ${notes.length - SOME} more` : ''}.` : '';
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
    name = file?.name ?? 'scenes.jsonl';
    hidden = isLarge ? text : '';
    area.value = isLarge ? '' : text;
    error.textContent = '';
    done.textContent = isLarge ? `${file.name} is open. It is too large to be shown here.` : '';
    count();
  }

  area.addEventListener('input', () => {
    hidden = '';
    done.textContent = '';
    count();
  });
  which.addEventListener('input', nameScene);
  map.addEventListener('change', () => (names.parentElement.hidden = map.value !== 'own'));
  get('open-file').addEventListener('click', () => {
    show(JSON.stringify(scene(), null, 1));
    listRecords();
    dialog.showModal();
    area.focus();
  });
  get('close-file').addEventListener('click', () => dialog.close());
  get('import').addEventListener('click', () => {
    try {
      place(chosen(found.length), source(), name);
      dialog.close();
    } catch (problem) {
      if (!(problem instanceof SceneError)) throw problem;
      error.textContent = problem.message;
    }
  });
  /** Puts a scene of a text on the board. Throws SceneError. */
  function place(index, text, of) {
    const scenes = scenesIn(text);
    const labels = labelsOf(map.value, names.value);
    const given = scenes.read(index, labels);
    if (given.notes && !given.scene.objects.length) {
      throw new SceneError(`The file has no object for a scene: ${given.notes[0]?.[2] ?? 'it lists no detection with a class'}.`);
    }
    // Only requests and training scenes have no notes.
    const lines = given.notes ? [] : linesIn(text, of);
    const line = lines.length ? records.open(lines, of)[index] : undefined;
    const { scene: read } = line ? scenesIn(JSON.stringify(line)).read(0, labels) : given;
    put(read, inWords(given.notes ?? []), line);
    opened = [text, of];
    const count = lines.length;
    recorded.open(lines, index);
    say(count > 1 ? `Scene ${index + 1} of ${count} is on the board.` : 'The scene is on the board.');
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
  return { place: (index) => place(index, ...opened) };
}

/** Saves a text as a file. */
function save(text, name) {
  const link = document.createElement('a');
  link.href = URL.createObjectURL(new Blob([text], { type: 'application/json' }));
  link.download = name;
  link.click();
  URL.revokeObjectURL(link.href);
}
