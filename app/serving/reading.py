"""Conversion of a request to a scene with ids, class indices and relations from poses.

The functions collect all errors of a request before they raise an exception. So a client can
correct all errors at once.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Final

from pydantic_core import to_json

from app.scene.frames import body_pose, is_optical
from app.scene.geometry import Viewpoint
from app.scene.labels import label_key
from app.scene.nearest import Guess, Match, spelt_alike
from app.scene.observe import observe
from app.scene.relations import CANONICAL, canonicalise
from app.scene.scene import Scene, SceneObject
from app.scene.vocabulary import Vocabulary
from app.serving.errors import (
    ContradictionError,
    Fault,
    InvalidRequestError,
    Location,
    RequestError,
    UnknownLabelsError,
    some_of,
)
from app.serving.warnings import scene_warnings
from scene_client.schemas import (
    Detection,
    Mapped,
    ObservedRelation,
    Quaternion,
    RelationName,
    SceneRequest,
    SceneWarning,
    UnknownLabels,
)
from scene_client.validation import MAX_ERRORS, PLAIN

MAX_SUGGESTED: Final = 32
"""Maximum number of searches for classes similar to an unknown label, per scene.

The same number limits the errors with suggestions per request.
"""
MAX_MAPPED: Final = 256
"""Maximum number of unknown labels per request that the service maps to the nearest class."""


Triple = tuple[int, int, int]


@dataclass(frozen=True, slots=True)
class Limits:
    """Limits on one scene and on its answer. The values come from the settings of the service.

    Attributes:
        objects: maximum number of objects in a scene.
        relations: maximum number of relations in a scene.
        answer_bytes: maximum size of an answer in bytes.
    """

    objects: int = 256
    relations: int = 4096
    answer_bytes: int = 16 * 2**20


@dataclass(slots=True)
class Faults:
    """The errors of a request found so far.

    Attributes:
        found: dictionary from each class of exception to its errors.
    """

    found: dict[type[RequestError], list[Fault]] = field(default_factory=dict)

    def add(
        self,
        kind: type[RequestError],
        location: Location,
        message: str,
        suggestions: Sequence[str] = (),
    ) -> None:
        """Add an error without raising it."""
        self.found.setdefault(kind, []).append(Fault(location, message, tuple(suggestions)))

    @property
    def are_many(self) -> bool:
        """Whether an answer cannot list further errors."""
        return sum(map(len, self.found.values())) >= MAX_ERRORS

    def raise_any(self) -> None:
        """Raise an exception if the request has errors.

        Raises:
            RequestError: the request has errors. The exception contains all errors of one class,
                the first class in `app.serving.errors` with errors.
        """
        for kind in RequestError.__subclasses__() if self.found else ():
            if kind in self.found:
                raise kind(self.found[kind])


@dataclass(slots=True)
class LookUps:
    """Searches for classes similar to unknown labels, shared by all scenes of one request.

    This class limits the number of searches, because a search takes 0.2 ms, and a batch may contain
    10,000 unknown labels.

    Attributes:
        suggestions: number of errors of the request that already have suggestions, or for which the
            service has looked for similar ids.
    """

    suggestions: int = 0
    _guesses: dict[tuple[int, str, bool], Guess | None] = field(default_factory=dict)
    _similar: dict[tuple[int, str, bool], tuple[Match, ...]] = field(default_factory=dict)

    # id() of a vocabulary stays unique, because the request keeps its models in memory.

    def guess(self, vocabulary: Vocabulary, label: str, *, is_room: bool) -> Guess | None:
        """Return what an unknown label probably stands for.

        Raises:
            OverflowError: the request has had `MAX_MAPPED` guesses.
        """
        key = id(vocabulary), label, is_room
        if key not in self._guesses:
            if len(self._guesses) >= MAX_MAPPED:
                raise OverflowError
            self._guesses[key] = vocabulary.guess(label, is_room=is_room)
        return self._guesses[key]

    def similar(self, vocabulary: Vocabulary, label: str, *, is_room: bool) -> tuple[Match, ...]:
        """Return the names most similar to a label, or none after `MAX_SUGGESTED` searches."""
        key = id(vocabulary), label, is_room
        if key not in self._similar:
            if len(self._similar) >= MAX_SUGGESTED:
                return ()
            self._similar[key] = vocabulary.nearest(label, is_room=is_room)
        return self._similar[key]


@dataclass(slots=True)
class Unknown:
    """The labels of one scene that the vocabulary does not list, and their treatment.

    Attributes:
        vocabulary: classes and room types of the model.
        treatment: value of the field `unknown_labels` of the request.
        look_ups: searches for similar classes, shared by all scenes of the request.
        ignored: names of the ignored objects.
        mapped: the class that replaces each label. A key consists of the label and whether it is a
            room type.
    """

    vocabulary: Vocabulary
    treatment: UnknownLabels
    look_ups: LookUps
    ignored: list[str] = field(default_factory=list)
    mapped: dict[tuple[str, bool], Mapped] = field(default_factory=dict)
    _guesses: dict[tuple[str, bool], Guess | None] = field(default_factory=dict)

    def resolve(
        self, label: str, name: str, location: Location, faults: Faults, *, is_room: bool = False
    ) -> int | None:
        """Return the class or room type that replaces an unlisted label.

        Each treatment accepts the syntax of detectors, such as "chair_12".

        Args:
            label: the label.
            name: name of the object with this label. The list of ignored names contains it if the
                label is ignored.
            location: location of the label in the request, for an error message.
            faults: list of errors. If the method refuses the label, it adds an error to this list.
            is_room: whether the label is the name of a room type.

        Returns:
            Index of the class or room type. None means that the label is ignored or refused.
        """
        found = self.vocabulary.read(label, is_room=is_room)
        if found is None and self.treatment.startswith("nearest"):
            found = self._guess(label, is_room=is_room)
        if found is not None:
            entry, similarity, rule = found
            name = (self.vocabulary.room_types if is_room else self.vocabulary.labels)[entry]
            mapped = Mapped(label=label, class_=name, similarity=similarity, rule=rule)
            self.mapped[label, is_room] = mapped
            return entry
        if self.treatment.endswith("ignore"):
            self.ignored.append(name)
        else:
            self._refuse(label, location, faults, is_room=is_room)
        return None

    def copy(self) -> Unknown:
        """Return a copy. A question with further labels changes only its own copy."""
        return replace(self, ignored=[*self.ignored], mapped={**self.mapped})

    def _guess(self, label: str, *, is_room: bool) -> Guess | None:
        key = label, is_room
        if key in self._guesses or len(self._guesses) < MAX_SUGGESTED:
            with suppress(OverflowError):
                guess = self.look_ups.guess(self.vocabulary, label, is_room=is_room)
                return self._guesses.setdefault(key, guess)
        return None

    def _refuse(self, label: str, location: Location, faults: Faults, *, is_room: bool) -> None:
        known = self.vocabulary.room_types if is_room else self.vocabulary.labels
        message = "the model does not know this label"
        if not is_room and self.vocabulary.room_index(label) is not None:
            message += "; it is a room type: send it as `room_type`"
        if is_room:
            message = "this model does not have room types"
            if known:
                message = f"the model does not know this room type; it knows {some_of(known)}"
        if self.treatment == "nearest" and (label, is_room) not in self._guesses:
            message += (
                f"; the service maps at most {MAX_SUGGESTED} unknown labels per scene and "
                f"{MAX_MAPPED} per batch to the nearest class"
            )
        suggestions: list[str] = []
        if self.look_ups.suggestions < MAX_SUGGESTED:
            matches = self.look_ups.similar(self.vocabulary, label, is_room=is_room)
            suggestions = [known[match.entry] for match in matches]
        self.look_ups.suggestions += bool(suggestions)
        faults.add(UnknownLabelsError, location, message, suggestions)


@dataclass
class Reading:
    """The scene of a request, with the class indices of a model.

    Attributes:
        scene: objects of known classes, their relations and the room type.
        ids: ids of the objects in `scene`.
        unknown: unknown labels of the request and their treatment.
        left_out: pairs (id, label) of the ignored objects.
        observed: relations that the service has derived from poses, or None without poses.
        flipped: relations of `scene` that the request states by their opposite, for example right
            instead of left. Each is a triple (relation, subject, object) of indices.
        warnings: warnings about probable mistakes in the scene.
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
        """Look-up of objects by id or label. The first access builds the look-up tables."""
        return Names(self)

    def longest_name(self) -> int:
        """Return the maximum size in bytes of an id or label in the JSON text of the answer."""
        text = "".join(self.ids)
        if text.isascii() and '"' not in text and "\\" not in text:
            longest = max(map(len, self.ids), default=0) + 2
        else:
            longest = max(len(to_json(name)) for name in self.ids)
        return max(longest, self.unknown.vocabulary.longest_label) + 1


class Names:
    """Look-up of the objects of a scene by id, or by label if only one object has the label."""

    def __init__(self, reading: Reading) -> None:
        self._unknown = reading.unknown
        self._objects = reading.scene.objects
        self._ignored_ids = {name for name, _ in reading.left_out}
        self._ignored_labels = {label_key(label) for _, label in reading.left_out}

    # The first access builds each table. Most requests never need the tables, because most requests
    # do not refer to objects by name.

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

    @cached_property
    def _plain_ids(self) -> list[str]:
        # A request cannot put arbitrary text into an error through its ids.
        return [thing.id for thing in self._objects if PLAIN.fullmatch(thing.id.replace(" ", "_"))]

    def find(self, name: str, location: Location, faults: Faults) -> int | None:
        """Return the index of the object with a name. On failure, add an error and return None.

        The name is an id or a label. Ids take precedence over labels. A label may have any spelling
        that the vocabulary accepts for its class.
        """
        if (place := self._by_id.get(name)) is not None:
            return place
        places = self._by_label.get(name)
        if places is None:
            index = self._unknown.vocabulary.index(name)
            places = [] if index is None else self._by_class.get(index, [])
        if len(places) == 1:
            return places[0]
        if places:
            message = (
                f"{len(places)} objects have this label; use the id of one of them. The service "
                "numbers objects without an id, such as chair_1 and chair_2"
            )
            faults.add(InvalidRequestError, location, message)
        else:
            message = "no entry of `objects` has this id or label"
            faults.add(InvalidRequestError, location, message, self._similar(name))
        return None

    def _similar(self, name: str) -> list[str]:
        """Return similar ids for the first `MAX_SUGGESTED` unknown names of a request."""
        if self._unknown.look_ups.suggestions >= MAX_SUGGESTED:
            return []
        self._unknown.look_ups.suggestions += 1
        return spelt_alike(name, self._plain_ids)

    def is_ignored(self, name: str) -> bool:
        """Return whether an ignored object has this id or label."""
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
) -> Reading:
    """Convert the scene of a request: find the class of each label, and derive relations.

    Args:
        request: the request.
        vocabulary: classes and room types of the model.
        limits: limits on the scene.
        look_ups: searches for similar classes, shared by all scenes of a batch. None means that the
            request has only this scene.
        may_be_empty: whether a scene without objects of known classes is valid.

    Raises:
        RequestError: the scene is invalid; see `Faults.raise_any`.
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
            if faults.found and faults.are_many:
                break
        if index is None:
            reading.left_out.append((ids[place], label))
        elif isinstance(entry, str):
            objects.append(SceneObject(ids[place], label, index))
        else:
            has_detections = True
            has_poses = has_poses or entry.position is not None
            objects.append(_scene_object(ids[place], entry, index, optical=optical))
    room, name = None, request.room_type
    if name is not None and (room := vocabulary.room_index(name)) is None:
        room = unknown.resolve(name, name, ("room_type",), faults, is_room=True)
    if not objects and not may_be_empty and not faults.found:
        faults.add(
            InvalidRequestError, ("objects",), "the model does not know any of these objects"
        )
    faults.raise_any()

    reading.scene = Scene(tuple(objects), None, False, room)
    if reading.left_out:
        left_out = {name for name, _ in reading.left_out}
        reading.ids = [name for name in ids if name not in left_out]
    stated = _stated(request, ids)
    if stated is not None:
        triples, reading.flipped = _triples(stated, reading, faults)
        faults.raise_any()
        reading.scene = Scene(reading.scene.objects, triples, request.relations_complete, room)
    if has_detections:
        _derive(request, reading, vocabulary, has_poses=has_poses)
    return reading


def _check_sizes(request: SceneRequest, limits: Limits, faults: Faults) -> None:
    for name, most in (("objects", limits.objects), ("relations", limits.relations)):
        if len(getattr(request, name) or ()) > most:
            faults.add(InvalidRequestError, (name,), f"the scene must have at most {most} {name}")
    if request.relations is None and request.relations_complete:
        message = "`relations_complete` requires the field `relations`"
        faults.add(InvalidRequestError, ("relations_complete",), message)
    faults.raise_any()


def _derive(
    request: SceneRequest, reading: Reading, vocabulary: Vocabulary, *, has_poses: bool
) -> None:
    """Add to ``reading`` the relations and warnings that follow from the poses of the objects."""
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
    """Return the ids of the objects in a request.

    An object without an id has its label as id. If several objects have this label, a number at the
    end makes the id unique.
    """
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
                faults.add(
                    InvalidRequestError, ("objects", place, "id"), "another object has this id"
                )
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
            while name == label or name in taken:
                last[label] += 1
                name = f"{label}_{last[label]}"
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
        if detection.yaw is not None:
            half = detection.yaw / 2
            turn = Quaternion(x=0.0, y=0.0, z=math.sin(half), w=math.cos(half))
        position, size, yaw = body_pose(
            (detection.position.x, detection.position.y, detection.position.z),
            size,
            None if turn is None else (turn.x, turn.y, turn.z, turn.w),
            optical=optical,
        )
    return SceneObject(
        name, detection.label, class_index, detection.confidence, position, size, yaw
    )


def _stated(
    request: SceneRequest, ids: Sequence[str]
) -> list[tuple[Location, str, RelationName, str]] | None:
    """Return the stated relations and supports with their locations.

    None means that positions decide.
    """
    supports: list[tuple[Location, str, RelationName, str]] = []
    has_positions = True
    for place, (name, entry) in enumerate(zip(ids, request.objects, strict=True)):
        if isinstance(entry, str) or entry.position is None:
            has_positions = False
        if not isinstance(entry, str) and entry.supported_by is not None:
            location = ("objects", place, "supported_by")
            supports.append((location, name, "on-top", entry.supported_by))
    if request.relations is None and (has_positions or not supports):
        return None
    relations = enumerate(request.relations or ())
    stated = [(("relations", n), one.subject, one.relation, one.object) for n, one in relations]
    return [*stated, *supports]


def _triples(
    stated: Sequence[tuple[Location, str, RelationName, str]], reading: Reading, faults: Faults
) -> tuple[tuple[Triple, ...], frozenset[Triple]]:
    """Return the canonical triples of the stated relations.

    The second value contains the triples that the request states by the opposite relation.
    """
    names, some_ignored = reading.names, bool(reading.left_out)
    triples: dict[Triple, bool] = {}
    for location, first, relation, second in stated:
        if some_ignored and (names.is_ignored(first) or names.is_ignored(second)):
            continue
        if faults.found and faults.are_many:
            break
        is_relation = location[0] == "relations"
        subject = names.find(first, (*location, "subject") if is_relation else location, faults)
        other = names.find(second, (*location, "object") if is_relation else location, faults)
        if subject is None or other is None:
            continue
        if subject == other:
            message = "an object cannot have a relation to itself"
            faults.add(ContradictionError, location, message)
            continue
        index, i, j = canonicalise(subject, relation, other)
        if (index, j, i) in triples:
            message = "this relation contradicts an earlier relation of the same two objects"
            faults.add(ContradictionError, location, message)
        triples.setdefault((index, i, j), i != subject)
    return tuple(triples), frozenset([triple for triple, flipped in triples.items() if flipped])
