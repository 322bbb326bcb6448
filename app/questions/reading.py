"""Conversion of a request to a scene with ids, class indices and relations from poses.

Warnings point out probable mistakes in poses and sizes: wrong units, a frame whose y axis points
up, and quaternions in a wrong order. Some checks use the typical sizes of the classes.
"""

import math
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from difflib import get_close_matches
from functools import cached_property
from itertools import compress, count
from statistics import median
from typing import Final

import numpy as np
from jaxtyping import Float
from numpy.typing import NDArray

from app.errors import ContradictionError, InvalidRequestError, Location
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
from app.scene.vocabulary import Vocabulary
from scene_client.frames import body_pose, is_optical, is_world_fixed
from scene_client.schemas import (
    Detection,
    ObservedRelation,
    RelationName,
    SceneRequest,
    SceneWarning,
)
from scene_client.schemas.answers import WarningCode


@dataclass(frozen=True, slots=True)
class Limits:
    """Limits on one scene and on its answer. The values come from the settings of the service."""

    objects: int = 256
    relations: int = 4096
    answer_bytes: int = 16 * 2**20


@dataclass
class Reading:
    """The scene of a request, with the class indices of a model."""

    scene: Scene  # without ignored objects
    unknown: Unknown
    left_out: list[tuple[str, str]]  # id and label of the ignored objects
    vocabulary: Vocabulary  # classes of the model, and of words that are read by their meaning
    observed: list[ObservedRelation] | None = None  # derived from poses; None: without poses
    warnings: list[SceneWarning] = field(default_factory=list)

    @cached_property
    def names(self) -> Names:
        """Look-up of objects by id or label. The first access builds the look-up tables."""
        return Names(self.scene.objects, self.unknown, self.left_out)


def read_scene(
    request: SceneRequest,
    vocabulary: Vocabulary,
    limits: Limits,
    look_ups: LookUps | None = None,  # shared by all scenes of a batch
    *,
    roles: RoleCounts | None = None,  # see `derive_relations`
    spread: Float[NDArray[np.floating], "V"] | None = None,  # see `observe`
    profiles: Sequence[str] = (),  # names of the model's profiles
    may_be_empty: bool = False,  # whether a scene without objects of known classes is valid
) -> Reading:
    """Convert the scene of a request: find the class of each label, and derive relations.

    Raises:
        RequestError: the scene is invalid; see `ErrorList.raise_any`.
    """
    errors = ErrorList()
    _check_fields(request, limits, errors)
    unknown = Unknown(vocabulary, request.unknown_labels, look_ups or LookUps())
    ids, left_out = _ids(request.objects, errors), list[tuple[str, str]]()
    detections: dict[int, Detection] = {}
    objects = vocabulary.bare_objects(ids) if ids == request.objects else None
    if objects is None:
        objects, detections = _objects(request, ids, unknown, left_out, errors)
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
    reading = Reading(Scene(objects, None, room, profile), unknown, left_out, vocabulary)
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
            viewpoint=None if view is None else Viewpoint(view.x, view.y, view.yaw),
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
        reading.warnings = _warnings(reading, in_frame, detections, request)
    return reading


def _objects(
    request: SceneRequest,
    ids: Sequence[str],
    unknown: Unknown,
    left_out: list[tuple[str, str]],
    errors: ErrorList,
) -> tuple[tuple[SceneObject, ...], dict[int, Detection]]:
    """Return the objects of known classes with poses in body axes, and their detections by index.

    Ignored objects are added to ``left_out``.
    """
    optical = is_optical(request.frame_id)
    objects: list[SceneObject] = []
    detections: dict[int, Detection] = {}
    for number, (name, entry) in enumerate(zip(ids, request.objects, strict=True)):
        at: Location = ("objects", number)
        label, at = (entry, at) if isinstance(entry, str) else (entry.label, (*at, "label"))
        index = unknown.resolve(label, name, at, errors)
        if index is None:
            left_out.append((name, label))
            if errors.by_class and errors.are_many:
                break
        elif isinstance(entry, str):
            objects.append(SceneObject(name, label, index))
        else:
            detections[len(objects)] = entry
            position, size, turn, yaw = None, None, None, 0.0
            if (extents := entry.size) is not None:
                size = (extents.x, extents.y, extents.z)
            if (centre := entry.position) is not None:
                if entry.yaw is not None:
                    turn = (0.0, 0.0, math.sin(entry.yaw / 2), math.cos(entry.yaw / 2))
                elif (quaternion := entry.orientation) is not None:
                    turn = (quaternion.x, quaternion.y, quaternion.z, quaternion.w)
                centre_in_frame = (centre.x, centre.y, centre.z)
                position, size, yaw = body_pose(centre_in_frame, size, turn, optical=optical)
            objects.append(SceneObject(name, label, index, entry.confidence, position, size, yaw))
    return tuple(objects), detections


def _profile(name: str, profiles: Sequence[str], errors: ErrorList) -> int | None:
    """Return the index of a profile, or None after an error."""
    if name in profiles:
        return profiles.index(name)
    similar = tuple(get_close_matches(name, profiles, 3, 0.0))
    errors.add(InvalidRequestError, ("profile",), "the model does not have this profile", similar)
    return None


def _check_fields(request: SceneRequest, limits: Limits, errors: ErrorList) -> None:
    """Refuse a scene that is too large or contradictory, before any costly step."""
    for name, most in (("objects", limits.objects), ("relations", limits.relations)):
        if len(getattr(request, name) or ()) > most:
            errors.add(InvalidRequestError, (name,), f"the scene must have at most {most} {name}")
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
_LEAST: Final = 3  # minimum number of objects for warnings about all objects of a scene
_FURNITURE: Final = 0.5  # minimum longest side of furniture in m; smaller objects may lie or stand
_MOST: Final = 0.75  # minimum share of the objects that agree on a mistake
_UNIT: Final = math.log(2.5)  # minimum log ratio to the typical sizes that means another unit
_TWICE: Final = math.log(2.0)  # log ratio that is more than the spread within a class
_BETTER: Final = math.log(1.5)  # minimum mean advantage of the y extents over the z extents
_UPRIGHT: Final = 0.05  # maximum component of a quaternion that counts as 0

_TOO_FAR: Final = (
    f"the object is more than {MOST_DISTANT:g} m from the viewer; positions must be in metres"
)
_ODD_SIZE: Final = (
    f"all sides of the object are below {SMALLEST * 1e3:g} mm, so its size is unknown, or a side "
    f"is above {LARGEST:g} m; sizes must be in metres"
)
_SCALED: Final = (
    "the sizes of these objects are about {:.2g} times the typical sizes of their classes; sizes "
    "must be in metres"
)
_Y_UP: Final = (
    "the sizes of these objects fit their classes only if the y axis points up; convert positions, "
    "sizes and orientations to a frame whose z axis points up"
)
_ROLLED: Final = (
    "these objects lie on their sides, but their sizes fit upright objects; the order of a "
    "quaternion is x, y, z, w, and the z axis of an optical frame points ahead"
)
_FLAT: Final = "all objects have the same depth along the optical axis; the depth may be missing"
_UNSIZED: Final = (
    "the service cannot derive vertical relations of this object: the object has no size, and its "
    "class has no typical size"
)

# A piece of furniture, and three misfits. The proportion of a box is its height, divided by the
# geometric mean of the two other sides. A misfit is the absolute log ratio of the proportion to the
# typical proportion, so it does not depend on the unit. The height is the extent along z of the
# scene, along y of the scene, and along the z axis of the box.
_Fit = tuple[SceneObject, float, float, float]


def _warnings(
    reading: Reading,
    scene: Scene,
    detections: Mapping[int, Detection],  # by index in the scene, without bare labels
    request: SceneRequest,
) -> list[SceneWarning]:
    """Return the warnings about a scene in the frame of the request (x forward, y left, z up)."""
    # Python loops are fast enough, because most scenes have no poses or pass all checks.
    classes = reading.vocabulary.objects
    placed = [thing for thing in scene.objects if thing.position is not None]
    sized, fits = _compared(scene, detections, reading.vocabulary)
    factor, scaled = _scaled(sized)
    odd = [
        one
        for one in scene.objects
        if one.size is not None and not SMALLEST <= max(one.size) <= LARGEST and one not in scaled
    ]
    rolled = _rolled(fits, detections)
    optical = is_optical(request.frame_id)
    y_up = () if optical else _y_up([fit for fit in fits if fit[0] not in rolled])
    unsized = [
        one
        for one in placed
        if one.size is None and (one.class_index is None or classes[one.class_index].size is None)
    ]
    are_derived = reading.observed is not None and len(placed) > 1
    kinds: list[tuple[WarningCode, str, Sequence[SceneObject]]] = [
        ("implausible-position", _TOO_FAR, _distant(placed, request)),
        ("implausible-size", _ODD_SIZE, odd),
        ("implausible-scale", _SCALED.format(factor), scaled),
        ("y-axis-up", _Y_UP, y_up),
        ("rolled-objects", _ROLLED, rolled),
        ("flat-scene", _FLAT, placed if optical and _is_flat(placed) else ()),
        ("unknown-sizes", _UNSIZED, unsized if are_derived else ()),
    ]
    return [
        SceneWarning(code=code, message=message, objects=[thing.id for thing in objects])
        for code, message, objects in kinds
        if objects
    ]


def _distant(placed: Sequence[SceneObject], request: SceneRequest) -> list[SceneObject]:
    """Return the objects too far from the viewer, or from the median of a map."""
    positions = [thing.position or _ORIGIN for thing in placed]
    centre = _ORIGIN
    if request.viewpoint is not None:
        centre = (request.viewpoint.x, request.viewpoint.y, 0.0)
    elif placed and is_world_fixed(request.frame_id):
        x, y, z = map(median, zip(*positions, strict=True))
        centre = (x, y, z)
    far = [math.dist(position, centre) > MOST_DISTANT for position in positions]
    return list(compress(placed, far))


def _is_flat(placed: Sequence[SceneObject]) -> bool:
    """Return whether all objects have the same depth, the distance along the optical axis."""
    depths = [thing.position[0] for thing in placed if thing.position is not None]
    return len(depths) >= _LEAST and max(depths) - min(depths) <= _SAME_DEPTH


def _compared(
    scene: Scene, detections: Mapping[int, Detection], vocabulary: Vocabulary
) -> tuple[list[tuple[SceneObject, float]], list[_Fit]]:
    """Compare sizes with the typical sizes of the classes, without thin objects.

    Return each object of known size with the mean log ratio of its sides to the typical sides, and
    the fits of the furniture with a position.
    """
    sized, fits = list[tuple[SceneObject, float]](), list[_Fit]()
    for number, detection in detections.items():
        thing, own = scene.objects[number], detection.size
        typical = None if thing.class_index is None else vocabulary.objects[thing.class_index].size
        if thing.size is None or typical is None or min(thing.size) < SMALLEST:
            continue
        volume_ratio = math.prod(thing.size) / math.prod(typical)
        sized.append((thing, math.log(volume_ratio) / 3))
        if own is None or thing.position is None or max(typical) < _FURNITURE:
            continue
        x, y, z = thing.size
        # The yaw decides which side of the box is nearer to the y axis.
        along_y = x if abs(math.sin(thing.yaw)) > abs(math.cos(thing.yaw)) else y
        # The square of a proportion is height³ / volume.
        by_z, by_y, by_own_z = (
            abs(math.log((height / typical[2]) ** 3 / volume_ratio)) / 2
            for height in (z, along_y, own.z)
        )
        fits.append((thing, by_z, by_y, by_own_z))
    return sized, fits


def _scaled(sized: Sequence[tuple[SceneObject, float]]) -> tuple[float, list[SceneObject]]:
    """Return the common factor of sizes and typical sizes, and its objects if it is implausible."""
    if len(sized) < _LEAST:
        return 1.0, []
    centre = median(scale for _, scale in sized)
    if abs(centre) < _UNIT:
        return 1.0, []
    agreeing = [thing for thing, scale in sized if abs(scale - centre) <= _TWICE]
    agree = len(agreeing) >= max(_LEAST, _MOST * len(sized))
    return math.exp(centre), agreeing if agree else []


def _rolled(fits: Sequence[_Fit], detections: Mapping[int, Detection]) -> list[SceneObject]:
    """Return the furniture that lies on its side, although it fits its class upright.

    One object may really have fallen over. So the list is empty, unless it has several objects, or
    all quaternions of the scene are turns about the vertical if w is read first.
    """
    rolled = [thing for thing, by_z, _, by_own_z in fits if by_own_z <= _TWICE <= by_z - by_own_z]
    if not rolled or len(rolled) >= _LEAST:
        return rolled
    turns = [one.orientation for one in detections.values() if one.orientation is not None]
    w_is_first = turns and all(max(abs(turn.y), abs(turn.z)) <= _UPRIGHT for turn in turns)
    return rolled if w_is_first else []


def _y_up(fits: Sequence[_Fit]) -> list[SceneObject]:
    """Return the furniture that fits its class better if y points up, if most furniture does."""
    advantages = [by_z - by_y for _, by_z, by_y, _ in fits]
    total = sum(advantages)
    agree = total >= _MOST * sum(map(abs, advantages))
    if len(advantages) < _LEAST or not agree or total < _BETTER * len(advantages):
        return []
    return [thing for (thing, *_), better in zip(fits, advantages, strict=True) if better > 0]
