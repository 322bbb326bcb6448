"""The recorded scenes of a home, in the classes of the model that adapts to it.

Only a person can tell a habit of the home from a fault. So an unconfirmed scene does not teach the
objects that the model reports as outliers: they are neither present nor absent there. A confirmed
scene or a written place teaches all its objects, and the classes that it confirms in its room type
count as confirmed in all recorded scenes of this room type.

One broken recording must not make the model blind. A scene with more than `MAX_CLASSES` classes
teaches nothing. A confirmed scene with more than `MAX_ALARMS` alarms counts as
unconfirmed. An hour has at most a quarter of the weight (`weights_of_hours`).

Each written place (`training.datasets.inventories`) is one confirmed scene. A thing that most such
places lack teaches nothing there, but the model never reports it. The model is also asked about
each written thing in typical scenes of its room type, because one row of a table gives no context.

Confirmed relations that the model reports as misplaced count as usual ones: the new model never
reports them. Relations and numbers of objects that repeat become likelier
(`training.fit.adapt_statistics`).
"""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Final

import numpy as np
import torch
from jaxtyping import Float, Int
from numpy.typing import NDArray

from app.model import SceneModel
from app.questions.misplaced import THE_FLOOR
from app.questions.outliers import intruders
from app.scene import Scene, Vocabulary
from app.scene.spatial_relations import STACKED
from training.datasets import AnnotatedScene, encode
from training.datasets.cases import Triple, scene_of
from training.datasets.inventories import SHARE, Place, complete_scene, shipped_inventory
from training.datasets.moved import has_boxes, posed_scene
from training.datasets.vocabulary import curated_names
from training.domain.own_words import JUDGED, with_new_words
from training.evaluation.asking import canonical_triple, index_of_ids, score_misplaced
from training.evaluation.parts import of_classes
from training.fit.adapt import HomeScenes, TrainedOn
from training.fit.adapt_statistics import Numbers

MAX_CLASSES: Final = 64  # of a recorded scene
MAX_ALARMS: Final = 12  # of a confirmed scene
MAX_EXCEPTIONS: Final = 64  # classes of a home that the model never reports

_LEAST_OF_HOUR, _SHARE_OF_HOUR = 20.0, 0.25
_TYPICAL = 4  # written scenes of a room type in which the model is asked about a written thing


@dataclass(frozen=True)
class HomeScene:
    """One recorded scene."""

    classes: Int[NDArray, "n"]  # distinct classes without structure, ascending
    left_out: Int[NDArray, "m"]  # the classes without influence on the fit
    room: int | None  # index of the room type
    group: str  # name that near-duplicates share
    confirmed: bool  # by a person
    written: bool = False  # by a person; other scenes were recorded

    @property
    def question(self) -> Scene:
        """The scene as a request without poses and relations."""
        return replace(of_classes(self.classes.tolist()), room_type=self.room)


@dataclass(frozen=True)
class Home:
    """The recorded scenes of a home."""

    parent: SceneModel  # the model before its adaptation, with the new classes and room types
    parent_classes: int  # number of classes of the model, without the new ones
    parent_rooms: int  # number of room types of the model, without the new ones
    scenes: tuple[HomeScene, ...]  # distinct recorded scenes, and the written places
    recorded: int  # number of recorded scenes, with the repeated ones
    # Ids of the unconfirmed scenes in which each label is left out.
    left_out: Mapping[str, Sequence[str]] = field(default_factory=dict)
    relations: frozenset[Triple] = frozenset()  # confirmed, but misplaced for the parent
    # Other relations, with the number of their recorded scenes; at least `JUDGED`.
    places: Mapping[Triple, int] = field(default_factory=dict)
    numbers: tuple[Numbers, ...] = ()  # of instances in the recorded scenes
    unlearnt: tuple[str, ...] = ()  # labels and room types beyond the limits
    too_large: tuple[str, ...] = ()  # ids of scenes with more than `MAX_CLASSES` classes
    doubted: tuple[str, ...] = ()  # ids of confirmed scenes with more than `MAX_ALARMS` alarms

    @classmethod
    def of(
        cls, model: SceneModel, recorded: Sequence[AnnotatedScene], places: Sequence[Place] = ()
    ) -> Home:
        """Read recorded scenes and written places in the classes of a model.

        Scenes with equal classes and room type count once, because a robot sees a room many times.
        """
        written = [*map(confirmed_scene, places)]
        parent, unlearnt = with_new_words(model, [*recorded, *written])
        distinct, too_large = _distinct(parent, recorded)
        doubted = {
            scene.scene_id
            for read, scene in distinct
            if read.confirmed and len(read.left_out) > MAX_ALARMS
        }
        of_places = [_written(parent, place) for place in places]
        habits = {(place.room, c) for place in of_places for c in place.classes.tolist()}
        for read, scene in distinct:
            if read.confirmed and scene.scene_id not in doubted:
                habits.update((read.room, c) for c in read.left_out.tolist())
        scenes, left_out = _without_doubt(parent, distinct, doubted, habits)
        trusted = [x for _, x in distinct if x.scene_id not in doubted]
        reported, repeated = seen_relations(parent, [*trusted, *written])
        return cls(
            parent=parent,
            parent_classes=len(model.vocabulary),
            parent_rooms=model.spec.C,
            scenes=(*scenes, *of_places),
            recorded=len(recorded),
            left_out=left_out,
            relations=frozenset(reported),
            places={triple: n for triple, n in repeated.items() if n >= JUDGED},
            numbers=tuple(
                _numbers(parent, x, one) for one, (_, x) in zip(scenes, distinct, strict=True)
            ),
            unlearnt=unlearnt,
            too_large=too_large,
            doubted=tuple(sorted(doubted)),
        )

    @property
    def trained_on(self) -> TrainedOn:
        """The classes and room types of the model without the new ones and the rare classes."""
        classes = torch.from_numpy(~self.parent.rarely_shown)
        classes[self.parent_classes :] = False
        return TrainedOn(classes, self.parent_rooms)

    @property
    def new_classes(self) -> tuple[str, ...]:
        """Labels of the new classes."""
        return self.parent.vocabulary.labels[self.parent_classes :]

    @property
    def new_rooms(self) -> tuple[str, ...]:
        """New room types."""
        return tuple(self.parent.vocabulary.room_types[self.parent_rooms :])

    @property
    def confirmed(self) -> int:
        """Number of distinct recorded scenes that a person has confirmed."""
        return sum(scene.confirmed and not scene.written for scene in self.scenes)

    @cached_property
    def written(self) -> Int[NDArray, "k"]:
        """Indices of the written places in `scenes`."""
        return np.flatnonzero([scene.written for scene in self.scenes])

    @cached_property
    def measurable(self) -> Int[NDArray, "N"]:
        """Indices of the recorded scenes with two classes: they can measure a gain."""
        several = np.flatnonzero((self.tensors.v.sum(1) >= 2).numpy())
        return np.setdiff1d(several, self.written)

    @cached_property
    def tensors(self) -> HomeScenes:
        """The scenes for the fit."""
        shape = len(self.scenes), len(self.parent.vocabulary)
        v, observed = torch.zeros(shape), torch.ones(shape, dtype=torch.bool)
        observed &= torch.from_numpy(~self.parent.vocabulary.structure)
        for row, scene in enumerate(self.scenes):
            v[row, scene.classes] = 1
            v[row, scene.left_out] = 0
            observed[row, scene.left_out] = False
        rooms = [-1 if scene.room is None else scene.room for scene in self.scenes]
        weights = weights_of_hours([None if x.written else x.group for x in self.scenes])
        return HomeScenes(v, observed, torch.tensor(rooms), torch.from_numpy(weights).float())

    def confirmed_alarms(self, artifact: SceneModel) -> Counter[str]:
        """Return the classes that a model reports, with the number of their confirmed scenes."""
        labels, counts = artifact.vocabulary.labels, Counter[str]()
        for scene in self.scenes:
            if scene.confirmed:
                alarms = set(alarms_of(artifact, scene.question).tolist())
                if scene.written:
                    alarms |= self._typical_alarms(artifact, scene)
                counts.update(labels[c] for c in sorted(alarms))
        return counts

    def _typical_alarms(self, artifact: SceneModel, scene: HomeScene) -> set[int]:
        """Return the classes of a written place that a model reports in typical scenes."""
        hosts = self._typical.get(-1 if scene.room is None else scene.room, ())
        alarms = set[int]()
        for c in scene.classes.tolist():
            for host in hosts:
                asked = replace(of_classes(sorted({*host, c})), room_type=scene.room)
                if c in alarms_of(artifact, asked):
                    alarms.add(c)
                    break
        return alarms

    @cached_property
    def _typical(self) -> Mapping[int, Sequence[tuple[int, ...]]]:
        """Classes of some scenes of each room type with written places, by its index."""
        found: dict[int, list[tuple[int, ...]]] = defaultdict(list)
        wanted = {scene.room for scene in self.scenes if scene.written}
        for scene in shipped_inventory().scenes(1, seed=0) if wanted else ():
            read = _read(self.parent, scene)
            if read.room in wanted and read.room is not None and len(found[read.room]) < _TYPICAL:
                found[read.room].append(tuple(read.classes.tolist()))
        return found


def with_exceptions(artifact: SceneModel, labels: Iterable[str]) -> SceneModel:
    """Return the model, which never reports objects of these classes."""
    exceptions, vocabulary = set(labels), artifact.vocabulary
    objects = [
        replace(entry, anywhere=entry.anywhere or entry.label in exceptions)
        for entry in vocabulary.objects
    ]
    return replace(artifact, vocabulary=replace(vocabulary, objects=objects))


def weights_of_hours(groups: Sequence[str | None]) -> Float[NDArray[np.float64], "N"]:
    """Return the weight of each scene: an hour has at most a quarter of the sum, or 20 scenes.

    A group is an hour of the recording, or a file without hours; None is a group of its own.
    """
    named = [f"own {k}" if group is None else f"hour {group}" for k, group in enumerate(groups)]
    _, index, size = np.unique(named, return_inverse=True, return_counts=True)
    most = float(size.max(initial=0))
    for _ in range(64):  # the largest solution of most = a quarter of the sum
        most = max(_LEAST_OF_HOUR, _SHARE_OF_HOUR * float(np.minimum(size, most).sum()))
    weights: Float[NDArray[np.float64], "N"] = (np.minimum(size, most) / size)[index]
    return weights


_Distinct = list[tuple["HomeScene", AnnotatedScene]]


def _distinct(
    parent: SceneModel, recorded: Sequence[AnnotatedScene]
) -> tuple[_Distinct, tuple[str, ...]]:
    """Return one scene for equal classes and room types, and the ids of too large scenes.

    Each scene leaves out the classes that the parent reports in it.
    """
    scenes: dict[tuple[object, ...], tuple[HomeScene, AnnotatedScene]] = {}
    too_large = []
    for scene in recorded:
        read = _read(parent, scene)
        if len(read.classes) > MAX_CLASSES:
            too_large.append(scene.scene_id)
            continue
        key = (read.room, read.classes.tobytes())
        if key not in scenes or read.confirmed:
            scenes[key] = read, scene
    distinct = [
        (replace(read, left_out=alarms_of(parent, read.question)), scene)
        for read, scene in scenes.values()
    ]
    return distinct, tuple(too_large)


def _without_doubt(
    parent: SceneModel,
    distinct: _Distinct,
    doubted: Collection[str],
    habits: Collection[tuple[int | None, int]],
) -> tuple[list[HomeScene], dict[str, list[str]]]:
    """Return the scenes without unconfirmed alarms, and the ids of the scenes with each of them."""
    scenes, left_out = [], defaultdict[str, list[str]](list)
    for read, scene in distinct:
        open_ones = [c for c in read.left_out.tolist() if (read.room, c) not in habits]
        confirmed = read.confirmed and scene.scene_id not in doubted
        rows = np.array([] if confirmed else open_ones, dtype=np.int64)
        scenes.append(replace(read, left_out=rows, confirmed=confirmed))
        for c in rows.tolist():
            left_out[parent.vocabulary.labels[c]].append(scene.scene_id)
    return scenes, dict(left_out)


def _read(parent: SceneModel, scene: AnnotatedScene) -> HomeScene:
    """Return the scene in the classes of the parent."""
    names, vocabulary = curated_names(), parent.vocabulary
    matches = [vocabulary.look_up(thing.label) for thing in scene.objects]
    classes = np.unique([match.entry for match in matches if match is not None]).astype(np.int64)
    classes = classes[~vocabulary.structure[classes]]
    room = names.room_index(scene.room_type, vocabulary) if parent.spec.C else None
    return HomeScene(classes, classes[:0], room, scene.group, scene.confirmed)


def _numbers(parent: SceneModel, scene: AnnotatedScene, read: HomeScene) -> Numbers:
    """Return the numbers of instances of the taught classes of a recorded scene."""
    total = Counter[int]()
    for thing in scene.objects:
        if (match := parent.vocabulary.look_up(thing.label)) is not None:
            total[match.entry] += thing.count
    taught = np.setdiff1d(read.classes, read.left_out)
    return Numbers(taught, np.array([total[c] for c in taught.tolist()], np.int64), read.room)


def confirmed_scene(place: Place) -> AnnotatedScene:
    """Return a confirmed scene with all things of a written place."""
    return replace(complete_scene(place), confirmed=True)


def _written(parent: SceneModel, place: Place) -> HomeScene:
    """Return the scene of a written place. Things with a small share do not influence the fit."""
    scene = _read(parent, confirmed_scene(place))
    largest_share: dict[int, float] = defaultdict(float)
    for group, item in place.items:
        if (match := parent.vocabulary.look_up(item.label)) is not None:
            largest_share[match.entry] = max(largest_share[match.entry], group.share * item.share)
    rare = [c for c in scene.classes.tolist() if largest_share[c] < SHARE]
    return replace(scene, left_out=np.array(rare, dtype=np.int64), written=True)


def alarms_of(artifact: SceneModel, scene: Scene) -> Int[NDArray, "n"]:
    """Return the classes that `/outliers` reports at medium sensitivity."""
    if not scene.objects:
        return np.zeros(0, np.int64)
    classes = intruders(artifact, scene)
    return classes[~artifact.rarely_shown[classes]]


def seen_relations(
    model: SceneModel, scenes: Sequence[AnnotatedScene]
) -> tuple[set[Triple], Counter[Triple]]:
    """Return stacked relations (a, i, j) of classes: reported in confirmed scenes, and repeated.

    The model judges each scene as stated and with its boxes, which also show where objects stand.
    The second result counts the scenes of each relation that the model reports in no scene.
    """
    reported, confirmed, seen = set[Triple](), set[Triple](), Counter[Triple]()
    if model.places is None:
        return confirmed, seen
    words = [_canonical(scene, model.vocabulary) for scene in scenes]
    pairs = zip(scenes, encode(words, model.vocabulary, model.places.roles), strict=True)
    for scene, encoded in pairs:
        holds, classes = encoded.instance_holds, encoded.instance_classes.tolist()
        triples = [(a, i, j) for a in STACKED for i, j in np.argwhere(holds[a]).tolist()]
        seen.update({(a, classes[i], classes[j]) for a, i, j in triples})
        asked = [scene_of(encoded, range(len(classes)), triples)]
        if has_boxes(encoded):
            asked.append(posed_scene(encoded))
        alarms = {x for one in asked if triples for x in _misplaced(model, one, classes)}
        reported |= alarms
        confirmed |= alarms if scene.confirmed else set()
    structure = model.vocabulary.structure
    kept = {x: n for x, n in seen.items() if not (x in reported or structure[[x[1], x[2]]].any())}
    return confirmed, Counter(kept)


def _misplaced(model: SceneModel, scene: Scene, classes: Sequence[int]) -> Iterator[Triple]:
    """Yield the stacked relations of classes that the model reports in a scene."""
    index = index_of_ids(scene)
    for entry in score_misplaced(model, scene):
        if entry["is_misplaced"] and entry["object"] != THE_FLOOR:
            a, i, j = canonical_triple(index, entry)
            if a in STACKED:
                yield a, classes[i], classes[j]


def _canonical(scene: AnnotatedScene, vocabulary: Vocabulary) -> AnnotatedScene:
    """Return the scene with the label of the class in place of each name of it."""
    matches = (vocabulary.look_up(thing.label) for thing in scene.objects)
    objects = tuple(
        thing if match is None else replace(thing, label=vocabulary.labels[match.entry])
        for thing, match in zip(scene.objects, matches, strict=True)
    )
    return replace(scene, objects=objects)
