"""From a request to a scene: names to ids, labels to classes, poses to relations.

One pass over the request gathers every fault before any is raised, so that a caller can mend all of
them at once.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field
from difflib import get_close_matches
from functools import cached_property
from typing import Final

from app.scene.frames import body_pose, is_optical
from app.scene.geometry import Viewpoint
from app.scene.labels import label_key
from app.scene.observe import observe
from app.scene.relations import CANONICAL, canonicalise
from app.scene.scene import Scene, SceneObject
from app.scene.vocabulary import Vocabulary
from app.schemas import Detection, ObservedRelation, SceneRequest
from app.serving.errors import Fault, Location, Reason, RequestError

MAX_SUGGESTED: Final = 32
"""How many unknown labels of one request get suggestions."""


@dataclass(frozen=True, slots=True)
class Limits:
    """What one scene may hold, as the operator chose."""

    objects: int = 256
    relations: int = 4096


@dataclass(slots=True)
class Faults:
    """What has been found wrong so far, by kind."""

    found: dict[Reason, list[Fault]] = field(default_factory=dict)

    def add(
        self, reason: Reason, location: Location, message: str, suggestions: Sequence[str] = ()
    ) -> None:
        """Note a fault and go on."""
        self.found.setdefault(reason, []).append(Fault(location, message, tuple(suggestions)))

    def raise_any(self) -> None:
        """Raise what was found; faults of form come before unknown labels, those before sense.

        Raises:
            RequestError: something was found.
        """
        if not self.found:
            return
        for reason in Reason:
            if reason in self.found:
                raise RequestError(reason, self.found[reason])


@dataclass(slots=True)
class Reading:
    """A request as the models see it, made once and never changed.

    Attributes:
        scene: the known objects, what holds between them, and the room.
        ignored: names of what the model does not know, left out as the request allowed.
        observed: relations derived from poses; None where there was nothing to derive from.
        names: how the request may name its objects.
    """

    scene: Scene
    ignored: tuple[str, ...]
    observed: list[ObservedRelation] | None
    names: Names

    @property
    def ids(self) -> list[str]:
        """The ids of the scene's objects."""
        return [thing.id for thing in self.scene.objects]


class Names:
    """How the objects of a scene may be named: by id, or by a label that only one of them has.

    Args:
        ignored: (id, label) of those that were left out.
    """

    def __init__(
        self,
        objects: Sequence[SceneObject],
        ignored: Sequence[tuple[str, str]],
        vocabulary: Vocabulary,
    ) -> None:
        self._vocabulary = vocabulary
        self._objects = objects
        self._ignored_ids = {name for name, _ in ignored}
        self._ignored_labels = {label_key(label) for _, label in ignored}

    # Made when first asked for: most requests name none of their objects.

    @cached_property
    def _by_id(self) -> dict[str, int]:
        return {thing.id: place for place, thing in enumerate(self._objects)}

    @cached_property
    def _by_label(self) -> dict[str, list[int]]:
        places: dict[str, list[int]] = {}
        for place, thing in enumerate(self._objects):
            places.setdefault(thing.label, []).append(place)
        return places

    @cached_property
    def _by_class(self) -> dict[int, list[int]]:
        places: dict[int, list[int]] = {}
        for place, thing in enumerate(self._objects):
            if thing.class_index is not None:
                places.setdefault(thing.class_index, []).append(place)
        return places

    def find(self, name: str, location: Location, faults: Faults) -> int | None:
        """The place of the one object that ``name`` names; else None, with a fault noted.

        Ids win over labels; a label in another spelling names the same class.
        """
        if (place := self._by_id.get(name)) is not None:
            return place
        places = self._by_label.get(name)
        if places is None:
            index = self._vocabulary.index(name)
            places = [] if index is None else self._by_class.get(index, [])
        if len(places) == 1:
            return places[0]
        if places:
            message = f"{len(places)} objects have this label: name one of them by its id"
            faults.add(Reason.INVALID, location, message)
        else:
            faults.add(Reason.INVALID, location, "names no object of the scene")
        return None

    def id(self, name: str) -> str | None:
        """The id of the one object that ``name`` names, if it names one."""
        place = self.find(name, (), Faults())
        return None if place is None else self._objects[place].id

    def is_ignored(self, name: str) -> bool:
        """Whether the name belongs to an object that was left out."""
        if name in self._by_id:
            return False
        return name in self._ignored_ids or label_key(name) in self._ignored_labels


def read_scene(
    request: SceneRequest, vocabulary: Vocabulary, limits: Limits, *, may_be_empty: bool = False
) -> Reading:
    """The scene of a request, in the classes of ``vocabulary``.

    Raises:
        RequestError: everything that is wrong with it, of the gravest kind found.
    """
    given, ignored, names = _given(request, vocabulary, limits, may_be_empty=may_be_empty)
    scene = observe(
        given,
        frame_id=request.frame_id,
        viewpoint=_viewpoint(request),
        typical_sizes=vocabulary.sizes,
    )
    observed = None if scene.poses is None else _relations(scene)
    return Reading(scene, tuple(ignored), observed, names)


def check_scene(request: SceneRequest, vocabulary: Vocabulary, limits: Limits) -> Names:
    """How a scene, which may be empty, names its objects: read but for what its poses show.

    Raises:
        RequestError: as `read_scene`, which then reads it without fault.
    """
    return _given(request, vocabulary, limits, may_be_empty=True)[2]


def _given(
    request: SceneRequest, vocabulary: Vocabulary, limits: Limits, *, may_be_empty: bool
) -> tuple[Scene, list[str], Names]:
    """What a request says, the names of what is left out, and names for the rest."""
    faults = Faults()
    if len(request.objects) > limits.objects:
        faults.add(
            Reason.INVALID, ("objects",), f"must not hold more than {limits.objects} objects"
        )
    if len(request.relations or ()) > limits.relations:
        faults.add(
            Reason.INVALID, ("relations",), f"must not hold more than {limits.relations} relations"
        )
    if request.relations_complete and request.relations is None:
        faults.add(Reason.INVALID, ("relations_complete",), "needs relations")
    faults.raise_any()

    ids = _ids(request.objects, faults)
    tolerant = request.unknown_labels == "ignore"
    objects: list[SceneObject] = []
    unknown: list[tuple[str, str]] = []
    optical = request.frame_id is not None and is_optical(request.frame_id)
    for place, (name, entry) in enumerate(zip(ids, request.objects, strict=True)):
        label = entry if isinstance(entry, str) else entry.label
        index = vocabulary.index(label)
        if index is not None:
            if isinstance(entry, str):
                objects.append(SceneObject(name, label, index))
            else:
                objects.append(_scene_object(name, entry, index, optical=optical))
        elif tolerant:
            unknown.append((name, label))
        else:
            location: Location = ("objects", place)
            if not isinstance(entry, str):
                location = (*location, "label")
            unknown_label(vocabulary, label, location, faults)
    ignored = [name for name, _ in unknown]
    room = _room(request, vocabulary, ignored, faults)
    faults.raise_any()
    if not objects and not may_be_empty:
        faults.add(Reason.INVALID, ("objects",), "the model knows none of the objects")
        faults.raise_any()

    names = Names(objects, unknown, vocabulary)
    triples = _triples(request, names, tolerant, faults)
    faults.raise_any()
    return Scene(tuple(objects), triples, request.relations_complete, room), ignored, names


def unknown_label(vocabulary: Vocabulary, label: str, location: Location, faults: Faults) -> None:
    """Note a label that the vocabulary does not have, with the nearest ones it has."""
    # A look through the whole vocabulary takes about 0.3 ms, and a request may hold hundreds.
    affordable = len(faults.found.get(Reason.UNKNOWN_LABELS, ())) < MAX_SUGGESTED
    faults.add(
        Reason.UNKNOWN_LABELS,
        location,
        "the model does not know this label",
        vocabulary.suggest(label) if affordable else (),
    )


def _ids(entries: Sequence[str | Detection], faults: Faults) -> list[str]:
    """The id of every object: its own, or its label, numbered where the label is not enough."""
    taken: dict[str, None] = {}
    labels = []
    for place, entry in enumerate(entries):
        if isinstance(entry, str):
            labels.append(entry)
        elif entry.id is None:
            labels.append(entry.label)
        else:
            if entry.id in taken:
                faults.add(Reason.INVALID, ("objects", place, "id"), "another object has this id")
            taken[entry.id] = None
    if len(taken) == len(entries):
        return list(taken)
    if not taken and len(set(labels)) == len(labels):
        return labels
    repeats = Counter(labels)
    last: Counter[str] = Counter()
    ids = []
    for entry in entries:
        if isinstance(entry, Detection) and entry.id is not None:
            ids.append(entry.id)
            continue
        label = name = entry if isinstance(entry, str) else entry.label
        if repeats[name] > 1 or name in taken:
            while True:
                last[label] += 1
                name = f"{label}_{last[label]}"
                if name not in taken:
                    break
        taken[name] = None
        ids.append(name)
    return ids


def _scene_object(
    name: str, detection: Detection, class_index: int, *, optical: bool
) -> SceneObject:
    position = size = None
    yaw = 0.0
    if detection.size is not None:
        size = (detection.size.x, detection.size.y, detection.size.z)
    if detection.position is not None:
        turn = detection.orientation
        position, size, yaw = body_pose(
            (detection.position.x, detection.position.y, detection.position.z),
            size,
            None if turn is None else (turn.x, turn.y, turn.z, turn.w),
            optical=optical,
        )
    return SceneObject(
        name, detection.label, class_index, detection.confidence, position, size, yaw
    )


def _room(
    request: SceneRequest, vocabulary: Vocabulary, ignored: list[str], faults: Faults
) -> int | None:
    if request.room_type is None:
        return None
    room = vocabulary.room_index(request.room_type)
    if room is not None:
        return room
    if request.unknown_labels == "ignore":
        ignored.append(request.room_type)
    else:
        faults.add(
            Reason.UNKNOWN_LABELS,
            ("room_type",),
            "the model does not know this room type"
            if vocabulary.room_types
            else "this model knows no room types",
            get_close_matches(request.room_type.casefold(), vocabulary.room_types),
        )
    return None


def _triples(
    request: SceneRequest, names: Names, tolerant: bool, faults: Faults
) -> tuple[tuple[int, int, int], ...] | None:
    if request.relations is None:
        return None
    triples: dict[tuple[int, int, int], None] = {}
    for place, relation in enumerate(request.relations):
        location: Location = ("relations", place)
        if tolerant and (names.is_ignored(relation.subject) or names.is_ignored(relation.object)):
            continue
        subject = names.find(relation.subject, (*location, "subject"), faults)
        other = names.find(relation.object, (*location, "object"), faults)
        if subject is None or other is None:
            continue
        if subject == other:
            message = "an object stands in no relation to itself"
            faults.add(Reason.CONTRADICTION, location, message)
            continue
        index, i, j = canonicalise(subject, relation.relation, other)
        if (index, j, i) in triples:
            message = "contradicts an earlier relation, which says the opposite of this pair"
            faults.add(Reason.CONTRADICTION, location, message)
        triples[index, i, j] = None
    return tuple(triples)


def _viewpoint(request: SceneRequest) -> Viewpoint | None:
    if request.viewpoint is None:
        return None
    return Viewpoint(request.viewpoint.x, request.viewpoint.y, request.viewpoint.yaw)


def _relations(scene: Scene) -> list[ObservedRelation]:
    ids = [thing.id for thing in scene.objects]
    return [
        ObservedRelation(ids[i], CANONICAL[a], ids[j])  # type: ignore[arg-type]
        for a, i, j in scene.relations or ()
    ]
