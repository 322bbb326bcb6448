"""From a request to a scene: names to ids, labels to classes, poses to relations.

One pass over the request gathers every fault before any is raised, so that a caller can mend all of
them at once.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Final

from pydantic_core import to_json

from app.scene.frames import body_pose, is_optical
from app.scene.geometry import Viewpoint
from app.scene.labels import label_key
from app.scene.nearest import ACCEPTED, Match
from app.scene.observe import observe
from app.scene.relations import CANONICAL, canonicalise
from app.scene.scene import Scene, SceneObject
from app.scene.vocabulary import Vocabulary
from app.serving.errors import Fault, Location, Reason, RequestError
from app.serving.warnings import scene_warnings
from scene_client.schemas import (
    Detection,
    Mapped,
    ObservedRelation,
    Relation,
    SceneRequest,
    SceneWarning,
    UnknownLabels,
)

MAX_SUGGESTED: Final = 32
"""How many unknown labels of one scene are looked up, to suggest or to take the nearest class; and
of one request, with all its scenes, to suggest."""
MAX_MAPPED: Final = 256
"""How many of one request are looked up to take the nearest class."""


Triple = tuple[int, int, int]


@dataclass(frozen=True, slots=True)
class Limits:
    """What one scene and its answer may hold, as the operator chose."""

    objects: int = 256
    relations: int = 4096
    answer_bytes: int = 16 * 2**20


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
class LookUps:
    """The unknown labels that one request has looked up, in all its scenes.

    A look-up takes .2 ms, and a batch may hold ten thousand unknown labels.

    Attributes:
        suggestions: how many faults with suggestions it has named.
    """

    suggestions: int = 0
    _found: dict[tuple[int, str, bool], tuple[Match, ...]] = field(default_factory=dict)

    def nearest(
        self, vocabulary: Vocabulary, label: str, *, is_room: bool, limit: int
    ) -> tuple[Match, ...] | None:
        """The entries like an unknown label; None where so many have been looked up already."""
        key = id(vocabulary), label, is_room  # the request keeps its models
        if key not in self._found:
            if len(self._found) >= limit:
                return None
            look_up = vocabulary.nearest_room if is_room else vocabulary.nearest
            self._found[key] = look_up(label)
        return self._found[key]


@dataclass(slots=True)
class Unknown:
    """What becomes of the labels of one request that the model does not know.

    Attributes:
        treatment: `SceneRequest.unknown_labels`.
        ignored: names of what was left out.
        mapped: labels by the class that stands for each.
        look_ups: those of the whole request.
    """

    vocabulary: Vocabulary
    treatment: UnknownLabels
    look_ups: LookUps
    ignored: list[str] = field(default_factory=list)
    mapped: dict[str, Mapped] = field(default_factory=dict)
    _looked_up: dict[tuple[str, bool], tuple[Match, ...]] = field(default_factory=dict)

    def resolve(
        self, label: str, name: str, location: Location, faults: Faults, *, is_room: bool = False
    ) -> int | None:
        """The class, or room type, that stands for an unknown label.

        Args:
            name: noted as ignored, where unknown labels are.
            location: of the label, for the fault that is noted where it is refused.

        Returns:
            None where it is ignored or refused.
        """
        if self.treatment == "ignore":
            self.ignored.append(name)
            return None
        matches = self._nearest(label, is_room=is_room)
        known = self.vocabulary.room_types if is_room else self.vocabulary.labels
        if self.treatment == "nearest" and matches and matches[0].similarity >= ACCEPTED:
            found, similarity = matches[0]
            self.mapped[label] = Mapped(
                label=label, class_=known[found], similarity=round(similarity, 3)
            )
            return found
        message = "the model does not know this label"
        if is_room:
            message = "the model does not know this room type"
            if not known:
                message = "this model knows no room types"
        if self.treatment == "nearest" and (label, is_room) not in self._looked_up:
            message += (
                f"; the nearest class is looked up for {MAX_SUGGESTED} labels of a scene and "
                f"{MAX_MAPPED} of a batch at most"
            )
        suggestions = [known[match.entry] for match in matches]
        if self.look_ups.suggestions >= MAX_SUGGESTED:
            suggestions = []
        self.look_ups.suggestions += bool(suggestions)
        faults.add(Reason.UNKNOWN_LABELS, location, message, suggestions)
        return None

    def copy(self) -> Unknown:
        """For a question with labels of its own: the reading stays as it is."""
        return replace(self, ignored=[*self.ignored], mapped={**self.mapped})

    def _nearest(self, label: str, *, is_room: bool) -> tuple[Match, ...]:
        key = label, is_room
        if key not in self._looked_up:
            if len(self._looked_up) >= MAX_SUGGESTED:
                return ()
            limit = MAX_SUGGESTED if self.treatment == "error" else MAX_MAPPED
            found = self.look_ups.nearest(self.vocabulary, label, is_room=is_room, limit=limit)
            if found is None:
                return ()
            self._looked_up[key] = found
        return self._looked_up[key]


@dataclass
class Reading:
    """A request's scene as the models see it, made once and never changed.

    Attributes:
        scene: the known objects, what holds between them, and the room.
        ids: of the scene's objects.
        unknown: what became of the labels that the model does not know.
        left_out: (id, label) of the objects that were left out.
        observed: relations derived from poses; None where there was nothing to derive from.
        flipped: canonical triples of `scene` that the request spelled from the other end.
        warnings: what is probably a mistake.
    """

    scene: Scene
    ids: list[str]
    unknown: Unknown
    left_out: list[tuple[str, str]] = field(default_factory=list)
    observed: list[ObservedRelation] | None = None
    flipped: frozenset[Triple] = frozenset()
    warnings: list[SceneWarning] = field(default_factory=list)

    @cached_property
    def names(self) -> Names:
        """How the request may name its objects; most requests name none."""
        return Names(self.scene.objects, self.left_out, self.unknown.vocabulary)

    def longest_name(self) -> int:
        """Bytes of the longest name in an answer as JSON."""
        text = "".join(self.ids)
        if text.isascii() and '"' not in text and "\\" not in text:
            longest = max(map(len, self.ids), default=0) + 2
        else:
            longest = max(len(to_json(name)) for name in self.ids)
        return max(longest, self.unknown.vocabulary.longest_label) + 1

    @property
    def ignored(self) -> tuple[str, ...]:
        """Names of what the model does not know, left out as the request allowed."""
        return tuple(self.unknown.ignored)


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

    def is_ignored(self, name: str) -> bool:
        """Whether the name belongs to an object that was left out."""
        if name in self._by_id:
            return False
        return name in self._ignored_ids or label_key(name) in self._ignored_labels


def read_scene(
    request: SceneRequest,
    vocabulary: Vocabulary,
    limits: Limits,
    look_ups: LookUps | None = None,
    *,
    may_be_empty: bool = False,
    derive: bool = True,
) -> Reading:
    """The scene of a request, in the classes of ``vocabulary``.

    Args:
        look_ups: those of the whole request, where it holds more than this scene.
        derive: whether to derive relations and warnings from poses; else the scene is only checked.

    Raises:
        RequestError: everything that is wrong with it, of the gravest kind found.
    """
    faults = Faults()
    _check_sizes(request, limits, faults)
    ids = _ids(request.objects, faults)
    unknown = Unknown(vocabulary, request.unknown_labels, look_ups or LookUps())
    reading = Reading(Scene(()), ids, unknown)
    objects: list[SceneObject] = []
    optical = request.frame_id is not None and is_optical(request.frame_id)
    has_poses = has_detections = False
    for place, entry in enumerate(request.objects):
        label = entry if isinstance(entry, str) else entry.label
        index = vocabulary.index(label)
        if index is None:
            location: Location = ("objects", place)
            if not isinstance(entry, str):
                location = (*location, "label")
            index = unknown.resolve(label, ids[place], location, faults)
        if index is None:
            reading.left_out.append((ids[place], label))
        elif isinstance(entry, str):
            objects.append(SceneObject(ids[place], label, index))
        else:
            has_detections = True
            has_poses = has_poses or entry.position is not None
            objects.append(_scene_object(ids[place], entry, index, optical=optical))
    room = None if request.room_type is None else _room(request.room_type, unknown, faults)
    if not objects and not may_be_empty and not faults.found:
        faults.add(Reason.INVALID, ("objects",), "the model knows none of the objects")
    if faults.found:
        faults.raise_any()

    reading.scene = Scene(tuple(objects), None, False, room)
    if reading.left_out:
        left_out = {name for name, _ in reading.left_out}
        reading.ids = [name for name in ids if name not in left_out]
    if request.relations is not None:
        triples, reading.flipped = _triples(request.relations, reading, faults)
        faults.raise_any()
        reading.scene = Scene(reading.scene.objects, triples, request.relations_complete, room)
    if derive and has_detections:
        _derive(request, reading, vocabulary, has_poses=has_poses)
    return reading


def _check_sizes(request: SceneRequest, limits: Limits, faults: Faults) -> None:
    if len(request.objects) > limits.objects:
        faults.add(
            Reason.INVALID, ("objects",), f"must not hold more than {limits.objects} objects"
        )
    if request.relations is None:
        if request.relations_complete:
            faults.add(Reason.INVALID, ("relations_complete",), "needs relations")
    elif len(request.relations) > limits.relations:
        faults.add(
            Reason.INVALID, ("relations",), f"must not hold more than {limits.relations} relations"
        )
    if faults.found:
        faults.raise_any()


def _derive(
    request: SceneRequest, reading: Reading, vocabulary: Vocabulary, *, has_poses: bool
) -> None:
    """Add to a reading what the poses of its objects say."""
    given = reading.scene
    if has_poses and given.relations is None:
        view = request.viewpoint
        reading.scene = observe(
            given,
            frame_id=request.frame_id,
            viewpoint=None if view is None else Viewpoint(view.x, view.y, view.yaw),
            typical_sizes=vocabulary.sizes,
        )
        ids = reading.ids
        reading.observed = [
            ObservedRelation(ids[i], CANONICAL[a], ids[j])  # type: ignore[arg-type]
            for a, i, j in reading.scene.relations or ()
        ]
    reading.warnings = scene_warnings(given, reading.scene, vocabulary, request)


def _ids(entries: Sequence[str | Detection], faults: Faults) -> list[str]:
    """The id of every object: its own, or its label, numbered where the label is not enough."""
    labels: list[str] = [entry for entry in entries if isinstance(entry, str)]
    if len(set(labels)) == len(entries):
        return labels
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


def _room(name: str, unknown: Unknown, faults: Faults) -> int | None:
    room = unknown.vocabulary.room_index(name)
    if room is not None:
        return room
    return unknown.resolve(name, name, ("room_type",), faults, is_room=True)


def _triples(
    relations: Sequence[Relation], reading: Reading, faults: Faults
) -> tuple[tuple[Triple, ...], frozenset[Triple]]:
    """The canonical triples, and those of them that are spelled from the other end."""
    names, some_ignored = reading.names, bool(reading.left_out)
    triples: dict[Triple, bool] = {}
    for place, relation in enumerate(relations):
        location: Location = ("relations", place)
        if some_ignored and (
            names.is_ignored(relation.subject) or names.is_ignored(relation.object)
        ):
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
        triples.setdefault((index, i, j), i != subject)
    return tuple(triples), frozenset([triple for triple, flipped in triples.items() if flipped])
