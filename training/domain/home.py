"""The recorded scenes of a home, in the classes of the model that adapts to it.

Only a person can tell a habit of the home from a fault. So an unconfirmed scene does not teach the
objects that the model reports as outliers: they are neither present nor absent there. A confirmed
scene teaches all its objects.

Each written place (`training.datasets.inventories`) is one confirmed scene. A thing that most such
places lack teaches nothing there, but the model never reports it.

Confirmed relations that the model reports as misplaced count as usual ones: the new model never
reports them (`app.model.Misplaced.confirmed`). Such a relation of two classes also counts like
`_SCENES` training scenes in the places of the model (`app.model.Places`), so the place
becomes a usual one for missing objects.

A label that the model cannot read becomes a new class. It is judged once `JUDGED` scenes show it.
"""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Final

import numpy as np
import torch
from jaxtyping import Int
from numpy.typing import NDArray

from app.model import SceneModel
from app.questions.misplaced import THE_FLOOR
from app.questions.outliers import intruders
from app.scene import ObjectClass, Scene, Vocabulary, label_key
from app.scene.spatial_relations import STACKED
from training.datasets import AnnotatedScene, encode
from training.datasets.cases import Triple, scene_of
from training.datasets.inventories import SHARE, Place, complete_scene
from training.datasets.moved import has_boxes, posed_scene
from training.datasets.vocabulary import curated_names
from training.evaluation.asking import canonical_triple, index_of_ids, score_misplaced
from training.evaluation.parts import of_classes
from training.fit.adapt import HomeScenes, TrainedOn, extended
from training.fit.regression import recalibrated

JUDGED = 3  # number of scenes with a new class from which its objects are judged


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

    @classmethod
    def of(
        cls, model: SceneModel, recorded: Sequence[AnnotatedScene], places: Sequence[Place] = ()
    ) -> Home:
        """Read recorded scenes and written places in the classes of a model.

        Scenes with equal classes and room type count once, because a robot sees a room many times.
        """
        confirmed = [*recorded, *map(confirmed_scene, places)]
        parent = _with_new_words(model, confirmed)
        scenes: dict[tuple[object, ...], tuple[HomeScene, str]] = {}
        for scene in recorded:
            read = _read(parent, scene)
            key = (read.room, read.classes.tobytes())
            if key not in scenes or read.confirmed:
                scenes[key] = read, scene.scene_id
        left_out: dict[str, list[str]] = defaultdict(list)
        for read, scene_id in scenes.values():
            for c in read.left_out.tolist():
                left_out[parent.vocabulary.labels[c]].append(scene_id)
        distinct = (*(read for read, _ in scenes.values()), *(_written(parent, x) for x in places))
        return cls(
            parent=parent,
            parent_classes=len(model.vocabulary),
            parent_rooms=model.spec.C,
            scenes=distinct,
            recorded=len(recorded),
            left_out=left_out,
            relations=frozenset(reported_relations(parent, confirmed)),
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
        return HomeScenes(v, observed, torch.tensor(rooms))

    def confirmed_alarms(self, artifact: SceneModel) -> Counter[str]:
        """Return the classes that a model reports, with the number of their confirmed scenes."""
        labels, counts = artifact.vocabulary.labels, Counter[str]()
        for scene in self.scenes:
            if scene.confirmed and len(scene.classes):
                alarms = alarms_of(artifact, scene.question)
                counts.update(labels[c] for c in alarms.tolist())
        return counts


def with_exceptions(artifact: SceneModel, labels: Iterable[str]) -> SceneModel:
    """Return the model, which never reports objects of these classes."""
    exceptions, vocabulary = set(labels), artifact.vocabulary
    objects = [
        replace(entry, anywhere=entry.anywhere or entry.label in exceptions)
        for entry in vocabulary.objects
    ]
    return replace(artifact, vocabulary=replace(vocabulary, objects=objects))


def _with_new_words(model: SceneModel, recorded: Sequence[AnnotatedScene]) -> SceneModel:
    """Return the model with the labels and room types that it cannot read."""
    names, vocabulary = curated_names(), model.vocabulary
    scenes_of: Counter[str] = Counter()
    rooms: dict[str, str] = {}
    for scene in recorded:
        labels = {label_key(thing.label): thing.label for thing in scene.objects}.values()
        scenes_of.update({names.canonical(x) for x in labels if vocabulary.look_up(x) is None})
        room = names.canonical_room(scene.room_type)
        if room is not None and names.room_index(scene.room_type, vocabulary) is None:
            rooms.setdefault(label_key(room), room)
    excluded = set(map(label_key, (*names.not_objects, *names.structure)))
    classes = [
        ObjectClass(label, anywhere=count < JUDGED)
        for label, count in sorted(scenes_of.items())
        if label_key(label) and label_key(label) not in excluded
    ]
    return extended(model, classes, sorted(rooms.values()) if model.spec.C else ())


def _read(parent: SceneModel, scene: AnnotatedScene) -> HomeScene:
    """Return the scene in the classes of the parent."""
    names, vocabulary = curated_names(), parent.vocabulary
    matches = [vocabulary.look_up(thing.label) for thing in scene.objects]
    classes = np.unique([match.entry for match in matches if match is not None]).astype(np.int64)
    classes = classes[~vocabulary.structure[classes]]
    room = names.room_index(scene.room_type, vocabulary) if parent.spec.C else None
    read = HomeScene(classes, classes[:0], room, scene.group, scene.confirmed)
    if scene.confirmed or not len(classes):
        return read
    return replace(read, left_out=alarms_of(parent, read.question))


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
    classes = intruders(artifact, scene)
    return classes[~artifact.rarely_shown[classes]]


_SCENES: Final = 20.0


def reported_relations(model: SceneModel, recorded: Sequence[AnnotatedScene]) -> set[Triple]:
    """Return the stacked relations (a, i, j) of classes that the model reports in confirmed scenes.

    The model judges each scene as stated and with its boxes, which also show where objects stand.
    """
    if model.places is None:
        return set()
    reported: set[Triple] = set()
    confirmed = [scene for scene in recorded if scene.confirmed]
    words = [_canonical(scene, model.vocabulary) for scene in confirmed]
    for encoded in encode(words, model.vocabulary, model.places.roles):
        holds = encoded.instance_holds
        triples = [(a, i, j) for a in STACKED for i, j in np.argwhere(holds[a]).tolist()]
        scenes = [scene_of(encoded, range(len(encoded.instance_classes)), triples)]
        if has_boxes(encoded):
            scenes.append(posed_scene(encoded))
        for scene in scenes if triples else ():
            index = index_of_ids(scene)
            for entry in score_misplaced(model, scene):
                if entry["is_misplaced"] and entry["object"] != THE_FLOOR:
                    a, i, j = canonical_triple(index, entry)
                    subject, other = encoded.instance_classes[[i, j]].tolist()
                    reported |= {(a, subject, other)} if a in STACKED else set()
    return reported


def _canonical(scene: AnnotatedScene, vocabulary: Vocabulary) -> AnnotatedScene:
    """Return the scene with the label of the class in place of each name of it."""
    matches = (vocabulary.look_up(thing.label) for thing in scene.objects)
    objects = tuple(
        thing if match is None else replace(thing, label=vocabulary.labels[match.entry])
        for thing, match in zip(scene.objects, matches, strict=True)
    )
    return replace(scene, objects=objects)


def with_confirmed(artifact: SceneModel, triples: Iterable[Triple]) -> SceneModel:
    """Return the model, which never reports these relations of classes."""
    places, V, triples = artifact.places, len(artifact.vocabulary), sorted(triples)
    if places is None:
        return artifact
    misplaced = artifact.calibration.misplaced.model_copy(update={"confirmed": tuple(triples)})
    # The keys of relation a between classes i and j; scene counts of equal keys are added.
    new = np.array([(a * V + i) * V + j for a, i, j in triples], places.triple.dtype)
    keys, index = np.unique(np.concatenate([places.triple, new]), return_inverse=True)
    scenes = np.bincount(index, np.concatenate([places.triple_scenes, np.full(len(new), _SCENES)]))
    places = replace(places, triple=keys, triple_scenes=scenes.astype(places.triple_scenes.dtype))
    return recalibrated(replace(artifact, places=places), misplaced=misplaced)
