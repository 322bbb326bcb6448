"""Conversion of a request to a scene with ids, class indices and relations from poses."""

import math
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from difflib import get_close_matches
from functools import cached_property
from itertools import compress, count

from app.errors import ContradictionError, InvalidRequestError, Location
from app.questions.names import ErrorList, LookUps, Names, Unknown
from app.questions.scene_warnings import scene_warnings
from app.scene.relation_table import RelationTable, Triple
from app.scene.roles import RoleCounts
from app.scene.scene import Scene, SceneObject, Viewpoint, observe
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
    observed: list[ObservedRelation] | None = None  # derived from poses; None: without poses
    warnings: list[SceneWarning] = field(default_factory=list)

    @property
    def vocabulary(self) -> Vocabulary:
        """The classes of the model, and those of the words that are read by their meaning."""
        words = list(self.unknown.words.values())
        return self.unknown.vocabulary.with_words(words) if words else self.unknown.vocabulary

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

    reading = Reading(Scene(objects, None, room, profile), unknown, left_out)
    stated = _stated(request, ids) if detections or request.relations is not None else None
    if stated is not None:
        is_opposite = _triples(stated, reading, errors)
        errors.raise_any()
        complete_for = len(objects) if request.relations_complete else None
        table = RelationTable.stated(
            is_opposite, list(is_opposite.values()), complete_for=complete_for
        )
        reading.scene = replace(reading.scene, relations=table)
    if detections:
        vocabulary = reading.vocabulary
        in_frame, view = reading.scene, request.viewpoint
        reading.scene = observe(
            in_frame,
            viewpoint=None if view is None else Viewpoint(view.x, view.y, view.yaw),
            has_viewer=view is not None or not is_world_fixed(request.frame_id),
            typical_sizes=vocabulary.sizes,
            stand_in=vocabulary.stand_in,
            roles=roles,
        )
        if reading.scene.has_boxes:
            reading.observed = [
                ObservedRelation(objects[i].id, CANONICAL[a], objects[j].id)  # type: ignore[arg-type]
                for a, i, j in reading.scene.triples
            ]
        reading.warnings = scene_warnings(
            in_frame, detections, vocabulary, request, derived=reading.scene.has_boxes
        )
    return reading


def _objects(
    request: SceneRequest,
    ids: Sequence[str],
    unknown: Unknown,
    left_out: list[tuple[str, str]],
    errors: ErrorList,
) -> tuple[tuple[SceneObject, ...], dict[int, Detection]]:
    """Return the objects of known classes, and the detections. Add ignored ones to ``left_out``."""
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
            objects.append(_scene_object(name, entry, index, optical=optical))
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
            names[index] = next(
                name for k in numbers[label] if (name := f"{label}_{k}") not in used
            )
        used.add(names[index])
    return names


def _scene_object(
    name: str, detection: Detection, class_index: int, *, optical: bool
) -> SceneObject:
    """Convert an object of a request, with its pose in body axes. ``name`` is its id."""
    position, size, turn, yaw = None, None, None, 0.0
    if (extents := detection.size) is not None:
        size = (extents.x, extents.y, extents.z)
    if (centre := detection.position) is not None:
        if detection.yaw is not None:
            half = detection.yaw / 2
            turn = (0.0, 0.0, math.sin(half), math.cos(half))
        elif (quaternion := detection.orientation) is not None:
            turn = (quaternion.x, quaternion.y, quaternion.z, quaternion.w)
        centre_in_frame = (centre.x, centre.y, centre.z)
        position, size, yaw = body_pose(centre_in_frame, size, turn, optical=optical)
    return SceneObject(
        name, detection.label, class_index, detection.confidence, position, size, yaw
    )


def _stated(
    request: SceneRequest, ids: Sequence[str]
) -> list[tuple[Location, str, RelationName, str]] | None:
    """Return (location, subject, relation, object), or None if positions give the relations."""
    supports: list[tuple[Location, str, RelationName, str]] = []
    has_positions = True
    for index, (name, entry) in enumerate(zip(ids, request.objects, strict=True)):
        if isinstance(entry, str) or entry.position is None:
            has_positions = False
        if not isinstance(entry, str) and entry.supported_by is not None:
            location = ("objects", index, "supported_by")
            supports.append((location, name, "on-top", entry.supported_by))
    if request.relations is None and (has_positions or not supports):
        return None
    relations = enumerate(request.relations or ())
    stated = [(("relations", n), r.subject, r.relation, r.object) for n, r in relations]
    return [*stated, *supports]


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
