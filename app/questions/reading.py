"""Conversion of a request to a scene with ids, class indices and relations from poses.

Warnings point out probable mistakes in poses and sizes. `app.questions.conventions` finds wrong
units, axes, extents, origins of boxes and orders of quaternions.
"""

import math
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from difflib import get_close_matches
from functools import cached_property
from itertools import compress, count
from statistics import median
from typing import Any, Final

import numpy as np
from jaxtyping import Float
from numpy.typing import NDArray

from app.errors import ContradictionError, InvalidRequestError, Location
from app.questions.alternatives import Guesses, read_guesses
from app.questions.conventions import Alternative, evidence_of, fields_to_declare
from app.questions.names import ErrorList, LookUps, Names, Unknown
from app.scene.relation_table import RelationTable, Triple
from app.scene.roles import RoleCounts
from app.scene.scene import (
    LARGEST,
    MOST_DISTANT,
    SMALLEST,
    Point,
    Scene,
    SceneObject,
    Viewpoint,
    observe,
)
from app.scene.spatial_relations import CANONICAL, canonicalise, support_cycle
from app.scene.vocabulary import Extents, Vocabulary, Word
from scene_client import schemas
from scene_client.frames import METRES, Conventions, is_optical, is_world_fixed
from scene_client.schemas import (
    Detection,
    ObservedRelation,
    RelationName,
    SceneRequest,
    SceneWarning,
)
from scene_client.schemas.answers import WarningCode

Decide = Callable[[Sequence[Word], Scene, Mapping[int, Guesses]], dict[int, NDArray[Any]]]
"""Function that returns the probabilities of the labels of objects: `label_probabilities`."""

_LEAST_CONFIDENCE: Final = 1e-6  # a smaller one counts as this; float32 divides by it
_MOST_LABELS: Final = 512  # labels of all objects with alternatives


@dataclass(frozen=True, slots=True)
class Limits:
    """Limits on one scene and on its answer. The values come from the settings of the service."""

    objects: int = 256
    relations: int = 4096
    answer_bytes: int = 16 * 2**20


@dataclass(frozen=True, slots=True)
class Decision:
    """The labels of one object with alternatives."""

    object: str  # id
    labels: Sequence[str]  # classes, likeliest first
    probabilities: Sequence[float]
    room: str | None = None  # id of its room in a home


@dataclass
class Reading:
    """The scene of a request, with the class indices of a model."""

    scene: Scene  # without ignored objects
    unknown: Unknown
    left_out: list[tuple[str, str]]  # id and label of the ignored objects
    vocabulary: Vocabulary  # classes of the model, and of words that are read by their meaning
    observed: list[ObservedRelation] | None = None  # derived from poses; None: without poses
    warnings: list[SceneWarning] = field(default_factory=list)
    resolved: list[Decision] = field(default_factory=list)

    @cached_property
    def names(self) -> Names:
        """Look-up of objects by id or label. The first access builds the look-up tables."""
        return Names(self.scene.objects, self.unknown, self.left_out)


def together(rooms: Mapping[str, Reading]) -> Reading:
    """Return a reading without objects, with the notes on all rooms of a home, by their id."""
    first = next(iter(rooms.values()))
    whole = Reading(replace(first.scene, objects=()), first.unknown, [], first.vocabulary)
    for name, room in rooms.items():
        whole.warnings += [one for one in room.warnings if one not in whole.warnings]
        whole.resolved += [replace(one, room=name) for one in room.resolved]
    return whole


def read_scene(
    request: SceneRequest,
    vocabulary: Vocabulary,
    limits: Limits,
    unknown: Unknown | None = None,  # shared by the rooms of a home
    *,
    roles: RoleCounts | None = None,  # see `derive_relations`
    spread: Float[NDArray[np.floating], "V"] | None = None,  # see `observe`
    stands: Float[NDArray[np.floating], "V 3"] | None = None,  # `Places.stands`
    profiles: Sequence[str] = (),  # names of the model's profiles
    decide: Decide | None = None,  # among several labels of an object; None: the first label
    may_be_empty: bool = False,  # whether a scene without objects of known classes is valid
) -> Reading:
    """Convert the scene of a request: find the class of each label, and derive relations.

    Raises:
        RequestError: the scene is invalid; see `ErrorList.raise_any`.
    """
    errors = ErrorList()
    _check_fields(request, limits, errors)
    if unknown is None:
        unknown = Unknown(vocabulary, request.unknown_labels, LookUps())
    ids, left_out = _ids(request.objects, errors), list[tuple[str, str]]()
    detections: dict[int, Detection] = {}
    guesses: dict[int, Guesses] = {}
    objects = vocabulary.bare_objects(ids) if ids == request.objects else None
    if objects is None:
        objects, detections = _objects(request, ids, unknown, left_out, errors, guesses)
    room, profile = None, None
    if (name := request.room_type) is not None:
        room = unknown.resolve(name, name, ("room_type",), errors, is_room=True)
    if request.profile is not None:
        profile = _profile(request.profile, profiles, errors)
    if not objects and not may_be_empty and not errors.by_class:
        message = "the model does not know any of these objects"
        errors.add(InvalidRequestError, ("objects",), message)
    errors.raise_any()

    if unknown.words:
        vocabulary = vocabulary.with_words(list(unknown.words.values()))
    scene = Scene(objects, None, room, profile)
    reading = Reading(scene, unknown, left_out, vocabulary)
    if guesses and decide is not None:
        p = decide(list(unknown.words.values()), scene, guesses)
        _decide(reading, guesses, p, detections, request)
        objects = reading.scene.objects
    entries = [entry for entry in request.objects if not isinstance(entry, str)]
    has_positions = len(entries) == len(ids) and all(item.position is not None for item in entries)
    has_supports = any(item.supported_by is not None for item in entries)
    if request.relations is not None or (detections and has_supports and not has_positions):
        is_opposite = _triples(_stated(request, ids), reading, errors)
        errors.raise_any()
        complete_for = len(objects) if request.relations_complete else None
        table = RelationTable.stated(
            is_opposite, list(is_opposite.values()), complete_for=complete_for
        )
        reading.scene = replace(reading.scene, relations=table)
    if detections:
        in_frame, view = reading.scene, request.viewpoint
        reading.scene = observe(
            in_frame,
            viewpoint=None if view is None else _viewpoint(view, request),
            has_viewer=view is not None or not is_world_fixed(request.frame_id),
            typical_sizes=vocabulary.sizes,
            spread=spread,
            stand_in=vocabulary.stand_in,
            roles=roles,
        )
        relations = reading.scene.relations
        if relations is not None and relations.of_boxes:
            reading.observed = [
                ObservedRelation(objects[i].id, CANONICAL[a], objects[j].id)  # type: ignore[arg-type]
                for a, i, j in relations.triples
            ]
        reading.warnings = _warnings(reading, in_frame, detections, request, stands)
    return reading


def _objects(
    request: SceneRequest,
    ids: Sequence[str],
    unknown: Unknown,
    left_out: list[tuple[str, str]],
    errors: ErrorList,
    guesses: dict[int, Guesses],
) -> tuple[tuple[SceneObject, ...], dict[int, Detection]]:
    """Return the objects of known classes with poses in body axes, and their detections by index.

    Ignored objects are added to ``left_out``, and objects with several labels to ``guesses``. Such
    an object has its first known label.
    """
    try:
        conventions = Conventions.of(request, request.frame_id)
    except ValueError as error:
        errors.add(ContradictionError, ("up",), str(error))
        return (), {}
    objects: list[SceneObject] = []
    detections: dict[int, Detection] = {}
    for number, (name, entry) in enumerate(zip(ids, request.objects, strict=True)):
        at: Location = ("objects", number)
        label, at = (entry, at) if isinstance(entry, str) else (entry.label, (*at, "label"))
        confidence = 1.0 if isinstance(entry, str) else entry.confidence
        if not isinstance(entry, str) and entry.alternatives:
            guess = read_guesses(entry, name, ("objects", number), unknown, errors)
            index = None
            if guess.classes:
                label, index = guess.labels[0], guess.classes[0]
                confidence = min(1.0, guess.confidence[0])
            if len(guess.classes) > 1:
                guesses[len(objects)] = guess
        else:
            index = unknown.resolve(label, name, at, errors)
        if index is None:
            left_out.append((name, label))
            if errors.by_class and errors.are_many:
                break
        elif isinstance(entry, str):
            objects.append(SceneObject(name, label, index))
        else:
            detections[len(objects)] = entry
            box = (
                *_box(entry, conventions, _typical_size(unknown.vocabulary, index)),
                *conventions.errors(entry.position_std, entry.size_std),
            )
            confidence = max(confidence, _LEAST_CONFIDENCE)
            objects.append(SceneObject(name, label, index, confidence, *box))
    return tuple(objects), detections


def _decide(
    reading: Reading,
    guesses: Mapping[int, Guesses],
    probabilities: Mapping[int, Float[NDArray[np.floating], "n"]],
    detections: Mapping[int, Detection],
    request: SceneRequest,
) -> None:
    """Give each object with several labels the likeliest one."""
    conventions = Conventions.of(request, request.frame_id)
    objects, vocabulary = list(reading.scene.objects), reading.vocabulary
    for row, p in probabilities.items():
        guess, thing, order = guesses[row], objects[row], np.argsort(-p, kind="stable").tolist()
        index, total = guess.classes[order[0]], min(1.0, sum(guess.confidence))
        position, size, yaw = _box(detections[row], conventions, _typical_size(vocabulary, index))
        objects[row] = replace(
            thing,
            label=guess.labels[order[0]],
            class_index=index,
            confidence=max(total * float(p[order[0]]), _LEAST_CONFIDENCE),
            position=position,
            size=size,
            yaw=yaw,
        )
        labels = [vocabulary.labels[guess.classes[k]] for k in order]
        reading.resolved.append(Decision(thing.id, labels, p[order].tolist()))
    reading.scene = replace(reading.scene, objects=tuple(objects))


def _typical_size(vocabulary: Vocabulary, index: int) -> Extents | None:
    """Return the typical size of a class, None if unknown or of a word."""
    known = vocabulary.objects
    return known[index].size if index < len(known) else None


def _box(
    entry: Detection, conventions: Conventions, typical: Extents | None
) -> tuple[Point | None, Point | None, float]:
    """Return centre, size and yaw of a detection in body axes."""
    position = None if (p := entry.position) is None else (p.x, p.y, p.z)
    size = None if (s := entry.size) is None else (s.x, s.y, s.z)
    turn = None if (q := entry.orientation) is None else (q.x, q.y, q.z, q.w)
    return conventions.box(position, size, turn, entry.yaw, typical=typical)


def _viewpoint(view: schemas.Viewpoint, request: SceneRequest) -> Viewpoint:
    """Return the viewpoint of a request in metres."""
    metres = METRES[request.units]
    return Viewpoint(view.x * metres, view.y * metres, view.yaw)


def _profile(name: str, profiles: Sequence[str], errors: ErrorList) -> int | None:
    """Return the index of a profile, or None after an error."""
    if name in profiles:
        return profiles.index(name)
    similar = tuple(get_close_matches(name, profiles, 3, 0.0))
    errors.add(InvalidRequestError, ("profile",), "the model does not have this profile", similar)
    return None


def _check_fields(request: SceneRequest, limits: Limits, errors: ErrorList) -> None:
    """Refuse a scene that is too large or contradictory, before any costly step."""
    if len(request.objects) > limits.objects:
        message = f"the scene must have at most {limits.objects} objects"
        errors.add(InvalidRequestError, ("objects",), message)
    several = [one for one in request.objects if not isinstance(one, str) and one.alternatives]
    if sum(1 + len(one.alternatives) for one in several) > _MOST_LABELS:
        message = f"objects with alternatives must have at most {_MOST_LABELS} labels together"
        errors.add(InvalidRequestError, ("objects",), message)
    if request.relations is None and request.relations_complete:
        message = "`relations_complete` requires the field `relations`"
        errors.add(InvalidRequestError, ("relations_complete",), message)
    errors.raise_any()


def _ids(entries: Sequence[str | Detection], errors: ErrorList) -> list[str]:
    """Return the ids. The default is the label, with a number if the label is not unique."""
    names = [
        entry if isinstance(entry, str) else entry.label if entry.id is None else entry.id
        for entry in entries
    ]
    if len(set(names)) == len(names):
        return names
    is_stated = [not isinstance(entry, str) and entry.id is not None for entry in entries]
    used: set[str] = set()
    for index in compress(count(), is_stated):
        if names[index] in used:
            errors.add(InvalidRequestError, ("objects", index, "id"), "another object has this id")
        used.add(names[index])
    labels = Counter(name for name, has_id in zip(names, is_stated, strict=True) if not has_id)
    numbers = {label: count(1) for label in labels}
    for index, label in enumerate(names):
        if is_stated[index]:
            continue
        if labels[label] > 1 or label in used:
            numbered = (f"{label}_{number}" for number in numbers[label])
            names[index] = next(name for name in numbered if name not in used)
        used.add(names[index])
    return names


def _stated(
    request: SceneRequest, ids: Sequence[str]
) -> list[tuple[Location, str, RelationName, str]]:
    """Return (location, subject, relation, object) of the relations that the request states."""
    stated: list[tuple[Location, str, RelationName, str]] = [
        (("relations", number), triple.subject, triple.relation, triple.object)
        for number, triple in enumerate(request.relations or ())
    ]
    for index, (name, entry) in enumerate(zip(ids, request.objects, strict=True)):
        if not isinstance(entry, str) and entry.supported_by is not None:
            location = ("objects", index, "supported_by")
            stated.append((location, name, "on-top", entry.supported_by))
    return stated


def _triples(
    stated: Sequence[tuple[Location, str, RelationName, str]], reading: Reading, errors: ErrorList
) -> dict[Triple, bool]:
    """Return the canonical triples of the stated relations, with True if stated by the opposite."""
    names, some_ignored = reading.names, bool(reading.left_out)
    triples: dict[Triple, bool] = {}
    for location, first, relation, second in stated:
        if some_ignored and (names.is_ignored(first) or names.is_ignored(second)):
            continue
        if errors.by_class and errors.are_many:
            break
        is_relation = location[0] == "relations"
        subject = names.find(first, (*location, "subject") if is_relation else location, errors)
        other = names.find(second, (*location, "object") if is_relation else location, errors)
        if subject is None or other is None:
            continue
        if subject == other:
            message = "an object cannot have a relation to itself"
            errors.add(ContradictionError, location, message)
            continue
        index, i, j = canonicalise(subject, relation, other)
        if (index, j, i) in triples:
            message = "this relation contradicts an earlier relation of the same two objects"
            errors.add(ContradictionError, location, message)
        triples.setdefault((index, i, j), i != subject)
    if circle := support_cycle(triples):
        ids = [reading.scene.objects[number].id for number in circle]
        message = f"objects hold each other in a circle: {' on or in '.join(ids)}"
        errors.add(ContradictionError, ("relations",), message)
    return triples


# ---------------------------------------------------------------------------------------- warnings

_ORIGIN: Final[Point] = (0.0, 0.0, 0.0)
_SAME_DEPTH: Final = 1e-3  # maximum difference in m of depths that count as equal
_LEAST_FLAT: Final = 3  # minimum number of objects of a flat scene

_TOO_FAR: Final = (
    f"the object is more than {MOST_DISTANT:g} m from the viewer; the unit of positions may differ "
    "from `units`"
)
_ODD_SIZE: Final = (
    f"all sides of the object are below {SMALLEST * 1e3:g} mm, so its size is unknown, or a side "
    f"is above {LARGEST:g} m; the unit of sizes may differ from `units`"
)
_FLAT: Final = "all objects have the same depth along the optical axis; the depth may be missing"
_UNSIZED: Final = (
    "the service cannot derive vertical relations of this object: the object has no size, and its "
    "class has no typical size"
)


def _warnings(
    reading: Reading,
    scene: Scene,
    detections: Mapping[int, Detection],  # by index in the scene, without bare labels
    request: SceneRequest,
    stands: Float[NDArray[np.floating], "V 3"] | None,
) -> list[SceneWarning]:
    """Return the warnings about a scene in the frame of the request (x forward, y left, z up)."""
    # Python loops are fast enough, because most scenes have no poses or pass all checks.
    classes = reading.vocabulary.objects
    placed = [thing for thing in scene.objects if thing.position is not None]
    likely = _likely_reading(reading, scene, detections, request, stands)
    # Another unit explains all odd positions and sizes.
    has_unit = likely is None or likely.scale == likely.place == 1.0
    odd = [
        one
        for one in scene.objects
        if one.size is not None and not SMALLEST <= max(one.size) <= LARGEST
    ]
    unsized = [
        one
        for one in placed
        if one.size is None and (one.class_index is None or classes[one.class_index].size is None)
    ]
    are_derived = reading.observed is not None and len(placed) > 1
    is_flat = is_optical(request.frame_id) and _is_flat(placed)
    kinds: list[tuple[WarningCode, str, Sequence[SceneObject]]] = [
        ("implausible-position", _TOO_FAR, _distant(placed, request) if has_unit else ()),
        ("implausible-size", _ODD_SIZE, odd if has_unit else ()),
        ("flat-scene", _FLAT, placed if is_flat else ()),
        ("unknown-sizes", _UNSIZED, unsized if are_derived else ()),
    ]
    warnings: list[SceneWarning] = []
    if likely is not None:
        declare = fields_to_declare(likely, request.frame_id)
        warnings = [
            SceneWarning(code="convention", message=likely.message, objects=[], declare=declare)
        ]
    return warnings + [
        SceneWarning(code=code, message=message, objects=[thing.id for thing in objects])
        for code, message, objects in kinds
        if objects
    ]


def _likely_reading(
    reading: Reading,
    scene: Scene,
    detections: Mapping[int, Detection],
    request: SceneRequest,
    stands: Float[NDArray[np.floating], "V 3"] | None,
) -> Alternative | None:
    """Return the likeliest reading of the boxes, or None for the declared conventions."""
    classes = reading.vocabulary.objects
    turns = {
        row: (q.x, q.y, q.z, q.w)
        for row, one in detections.items()
        if (q := one.orientation) is not None
    }

    def reread(conventions: Conventions) -> list[SceneObject]:
        """Return the objects under other conventions."""
        objects = list(scene.objects)
        for row in turns:
            index = objects[row].class_index
            typical = None if index is None else classes[index].size
            position, size, yaw = _box(detections[row], conventions, typical)
            objects[row] = replace(objects[row], position=position, size=size, yaw=yaw)
        return objects

    declared = Conventions.of(request, request.frame_id)
    evidence = evidence_of(scene.objects, turns, declared, reading.vocabulary, stands, reread)
    return None if evidence is None else evidence.likeliest


def _distant(placed: Sequence[SceneObject], request: SceneRequest) -> list[SceneObject]:
    """Return the objects too far from the viewer, or from the median of a map."""
    positions = [thing.position or _ORIGIN for thing in placed]
    centre = _ORIGIN
    if request.viewpoint is not None:
        x, y, _ = _viewpoint(request.viewpoint, request)
        centre = (x, y, 0.0)
    elif placed and is_world_fixed(request.frame_id):
        x, y, z = map(median, zip(*positions, strict=True))
        centre = (x, y, z)
    far = [math.dist(position, centre) > MOST_DISTANT for position in positions]
    return list(compress(placed, far))


def _is_flat(placed: Sequence[SceneObject]) -> bool:
    """Return whether all objects have the same depth, the distance along the optical axis."""
    depths = [thing.position[0] for thing in placed if thing.position is not None]
    return len(depths) >= _LEAST_FLAT and max(depths) - min(depths) <= _SAME_DEPTH
