/** The view "Where is it?": the likely rooms and places of one thing in a home. */

import { call, ProblemError, UnreachableError } from './api.js';
import { combobox } from './combobox.js';
import { calls, problemWords } from './columns.js';
import { el, redraw } from './dom.js';
import { asRequest } from './importing.js';
import { UNKNOWN_LABELS } from './questions.js';
import { fromScene, SceneError, toScene } from './scene.js';
import { isOnBoard, nowhere, thingAt } from './spots.js';
import { changed } from './store.js';
import { hereWords, placeRows, placeWords, roomRows, searchChips } from './where_rows.js';
import { percent, plain, shown, wordOf } from './words.js';

const MOST_ROOMS = 32; // of the service
const PLACES = 256; // of the answer; the board sums the places of an object

/** The objects of a scene without positions: the rooms of a file have no common axes. */
const objectsOf = (scene) => toScene({ relations: [], room: '', ...scene, posed: false }, new Map()).objects;

const timeOf = ({ stamp }) => (stamp ? stamp.sec + (stamp.nanosec ?? 0) / 1e9 : -Infinity);

/**
 * The rooms of a file with several scenes, each with its newest scene. A room has the name of its room type. If no
 * scene has a room type, each scene is a room.
 * @returns {import('./spots.js').Room[]}
 */
export function roomsOf(scenes, records) {
  if (scenes.length < 2) return [];
  const isTyped = scenes.some(({ scene }) => scene?.room_type);
  const newest = new Map();
  scenes.forEach(({ name, scene, notes }, index) => {
    if (!Array.isArray(scene?.objects)) return; // such as the last line of a recording, if it is cut off
    const own = scene.room_type ?? (isTyped ? '' : (notes && name) || scene.scene_id || `scene ${index + 1}`);
    const before = newest.get(plain(own));
    if (own && !(timeOf(scene) < before?.time)) newest.set(plain(own), { name: own, scene: records.current(scene), index, time: timeOf(scene) });
  });
  const last = [...newest.values()].sort((a, b) => a.time - b.time || a.index - b.index).slice(-MOST_ROOMS);
  return last.sort((a, b) => a.index - b.index).flatMap(({ name, scene, index }) => {
    try {
      return { name, index, scene_id: scene.scene_id, objects: objectsOf(fromScene(asRequest(scene), new Map())) };
    } catch (error) {
      if (!(error instanceof SceneError)) throw error;
      return []; // The board shows the error of this scene.
    }
  });
}

/** @param {(index: number) => void} go puts a scene of the opened file on the board */
export function createWhere(panel, store, say, go) {
  const get = (name) => panel.querySelector(`#${name}`);
  const [form, chips, rest, article] = ['add-room', 'home', 'home-note', 'whereabouts'].map(get);
  const name = form.elements.namedItem('name');
  const own = {
    title: el('h3'), again: el('button', { type: 'button', onclick: startAgain }, 'Start again'),
    problem: el('div', { class: 'problem', role: 'alert', hidden: true }), note: el('p', { class: 'quiet' }),
    searched: el('ul', { class: 'chips', 'aria-label': 'Searched without finding it' }),
    places: el('ol', { 'aria-label': 'Places' }), rooms: el('ul', { 'aria-label': 'Rooms' }), calls: calls(),
  };
  const [roomsTitle, placesTitle] = [el('h4', {}, 'Rooms'), el('h4', {}, 'Places')];
  article.append(el('header', {}, own.title, own.again), own.problem, own.note, own.searched, roomsTitle, own.rooms, placesTitle, own.places, own.calls.node);
  const here = document.getElementById('here');
  let controller = new AbortController();

  const update = (change) => store.set({ where: { ...store.get().where, ...change } });

  function bodyOf({ where: { rooms, wanted, searched }, models, shown }) {
    return {
      label: wanted,
      rooms: rooms.map(({ name: id, room_type: type, objects }) => ({ id, ...(type && { room_type: type }), objects })),
      ...(searched.length && { searched }), top_k: PLACES, model: models[shown], unknown_labels: UNKNOWN_LABELS,
    };
  }

  /** The rooms, with the objects of the board in the room of its scene. */
  const withBoard = ({ where: { rooms }, line, things }) => rooms.map((room) => (
    room.index !== undefined && room.scene_id === line.scene_id ? { ...room, objects: objectsOf({ things }) } : room));

  /** @param {object | null} before the answer before a search, for comparison */
  async function ask(before = null) {
    controller.abort();
    controller = new AbortController();
    const { signal } = controller;
    update({ rooms: withBoard(store.get()) });
    const state = store.get();
    if (!state.where.wanted || !state.where.rooms.length) {
      update({ answer: null, before: null, problem: null, status: 'none', body: null });
      return;
    }
    const body = bodyOf(state);
    update({ status: 'asking', body });
    try {
      const answer = await call('where', body, signal);
      update({ status: 'answered', answer, before, problem: null });
      const [first] = answer.places;
      say(`${wordOf(answer)}: ${first ? `most likely ${placeWords(first, store.get().where)}, ${percent(first.probability)}. ` : ''}Not here: ${percent(answer.not_here)}.`);
    } catch (error) {
      if (signal.aborted) return;
      if (error instanceof UnreachableError) {
        update({ status: 'down' });
        store.set({ down: true });
      } else if (error instanceof ProblemError) {
        update({ status: 'refused', answer: null, before: null, problem: error.problem });
      } else {
        throw error;
      }
    }
  }

  /** Changes the rooms. Searches elsewhere than in the rooms are dropped. */
  function setRooms(rooms) {
    const searched = store.get().where.searched.filter(({ room, object }) => rooms.some((one) => (
      one.name === room && (object == null || one.objects.some(({ id }) => id === object)))));
    update({ rooms, searched });
    void ask();
  }

  /** Changes the searches of the thing. The next answer shows the former probabilities too. */
  function search(searched) {
    const { answer } = store.get().where;
    update({ searched });
    void ask(answer);
  }

  const look = ({ room, object }) => search([...store.get().where.searched, { room, ...(object != null && { object }) }]);

  function takeBack(index) {
    search(store.get().where.searched.filter((_, other) => other !== index));
    if (!store.get().where.searched.length) get('wanted').focus();
  }

  function startAgain() {
    update({ searched: [] });
    get('wanted').focus();
    void ask();
  }

  /** Selects the object of a place. If the board shows another room of the file, it shows this one first. */
  function show(place) {
    const room = store.get().where.rooms.find((one) => one.name === place.room);
    if (!thingAt(place, store.get())) go(room.index);
    const thing = thingAt(place, store.get());
    if (thing) store.set({ selected: thing.id });
  }

  function drawRooms({ where: { rooms } }) {
    redraw(chips, rooms.map((room) => el('li', {}, shown(room.name), el('span', { class: 'quiet' }, ` ${room.objects.length} `), el('button', {
      type: 'button', class: 'icon', 'data-key': room.name, 'aria-label': `Remove the room ${shown(room.name)}`,
      onclick: () => {
        setRooms(store.get().where.rooms.filter((one) => one.name !== room.name));
        if (store.get().where.rooms.length === 0) name.focus();
      },
    }, '✕'))));
    rest.textContent = rooms.length ? '' : 'Open a file with a scene of each room, or put the objects of a room on the board and add the room.';
  }

  function drawAnswer(state) {
    const { wanted, searched, answer, problem, status, rooms, body } = state.where;
    article.hidden = !wanted;
    article.setAttribute('aria-busy', String(status === 'asking'));
    own.title.textContent = shown(answer ? wordOf(answer) : wanted);
    own.again.hidden = !searched.length;
    own.problem.hidden = !problem;
    own.problem.replaceChildren(...(problem ? problemWords(problem, body) : []));
    const looks = searched.length ? `Looked at ${searched.length} ${searched.length === 1 ? 'place' : 'places'} without finding it.` : '';
    own.note.textContent = [
      answer?.listed_as ? `class: ${answer.label}.` : '', looks,
      rooms.length ? (status === 'down' ? 'Waiting for the service.' : '') : 'Add a room first.',
    ].filter(Boolean).join(' ');
    redraw(own.searched, searchChips(state, takeBack));
    redraw(own.rooms, roomRows(state, (room) => go(room.index)));
    redraw(own.places, placeRows(state, { show, look }));
    roomsTitle.hidden = placesTitle.hidden = !answer;
    own.calls.show('where', answer ? body : null);
  }

  combobox(get('wanted'), get('wanted-found'), () => store.get().words[store.get().models[0]]?.objects ?? [], (wanted) => {
    update({ wanted, searched: [], answer: null, before: null, problem: null });
    void ask();
  });
  form.addEventListener('submit', (event) => {
    event.preventDefault();
    const { where: { rooms }, room, things, line } = store.get();
    const own = name.value.trim() || room;
    const others = rooms.filter((one) => one.name !== own);
    name.setCustomValidity(!own ? 'The room needs a name.' : others.length >= MOST_ROOMS ? `A home can have at most ${MOST_ROOMS} rooms.` : '');
    if (!name.reportValidity()) return;
    const added = { name: own, scene_id: line.scene_id, objects: objectsOf({ things }), ...(room && room !== own && { room_type: room }) };
    setRooms([...others, added]);
    name.value = '';
    say(`${shown(own)} added with ${things.length} ${things.length === 1 ? 'object' : 'objects'}.`);
  });
  name.addEventListener('input', () => name.setCustomValidity(''));
  store.subscribe((state, previous) => {
    if (state.where.wanted && changed(state, previous, 'models', 'shown', 'epoch')) void ask();
  });
  drawRooms(store.get());
  drawAnswer(store.get());

  return {
    /** Notes that the board shows a scene of the opened file. */
    placed(index) {
      const { scene_id: id } = store.get().line;
      update({ rooms: store.get().where.rooms.map((room) => (room.index === index ? { ...room, scene_id: id } : room)) });
    },
    /** Replaces the rooms by those of an opened file. A file with one scene leaves them. */
    useRooms(rooms) {
      if (!rooms.length) return;
      update({ ...nowhere(), wanted: store.get().where.wanted });
      setRooms(rooms);
    },
    /** The entries of the menu of an object: a search without success, if the object is in a room of the home. */
    menuOf(id) {
      const state = store.get();
      const room = state.tab === 'where' && state.where.wanted && state.where.rooms.find((one) => isOnBoard(one, state));
      const place = room && { room: room.name, object: id };
      return place && thingAt(place, state) ? [[`Looked here, no ${shown(state.where.wanted)}`, () => look(place)]] : [];
    },
    render(state, previous) {
      if (changed(state, previous, 'where', 'things', 'line', 'tab', 'draft')) {
        here.textContent = hereWords(state);
        here.hidden = !here.textContent;
      }
      if (state.room !== previous.room) name.placeholder = state.room || 'kitchen';
      if (state.where.rooms !== previous.where.rooms) drawRooms(state);
      if (changed(state, previous, 'where', 'things', 'line')) drawAnswer(state);
    },
  };
}
