"""Encode annotated scenes as model input: class indices and observed relations."""

from __future__ import annotations

import hashlib
import itertools
import math
from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from functools import cache
from typing import Final

import numpy as np
from jaxtyping import Bool, Float, Int
from numpy.typing import NDArray

from app.scene import (
    CANONICAL,
    PoseRelations,
    RoleCounts,
    Viewpoint,
    Vocabulary,
    canonicalise,
    derive_relations,
    label_key,
    to_viewer_frame,
)
from app.scene.roles import IN, ON, likely_role
from app.scene.scene import CONTACT, pool_classes
from app.scene.spatial_relations import INSIDE, ON_TOP, STACKED, SUPPORTS, pool_relations
from app.scene.stands import FLOOR, HANGS, SUPPORTED, UNKNOWN, Heights, stands_of
from scene_client.image_plane import are_neighbours, relation_between
from training.datasets.array_types import ClassMask
from training.datasets.records import AnnotatedObject, AnnotatedScene, Box2d
from training.datasets.roles import lift_of
from training.datasets.sources import Meaning, meaning_of, source_of
from training.datasets.vocabulary import curated_names

A = len(CANONICAL)
# Roles of an object at its support.
_SUPPORTED: Final = np.isin(range(3), (ON, IN))
_IN_THE_IMAGE: Final = [CANONICAL.index("left"), CANONICAL.index("above")]


@dataclass(frozen=True, slots=True, eq=False)
class ClassEvidence:
    """The n distinct classes of a scene and their observed relations."""

    classes: Int[NDArray, "n"]  # in ascending order
    counts: Int[NDArray, "n"]  # number of instances of each class
    holds: Bool[NDArray, "A n n"]  # [a, x, y]: classes[x] has relation a to classes[y]
    observed: Bool[NDArray, "A n n"]  # also True where a relation holds

    def only(self, rows: Int[NDArray, "m"]) -> ClassEvidence:
        """Return the evidence about some of the classes; `rows` are ascending indices of them."""
        pairs = np.ix_(np.arange(len(self.holds)), rows, rows)
        holds, observed = self.holds[pairs], self.observed[pairs]
        return ClassEvidence(self.classes[rows], self.counts[rows], holds, observed)


def pool_instances(
    classes: Int[NDArray, "N"], holds: Bool[NDArray, "A N N"], observed: Bool[NDArray, "A N N"]
) -> ClassEvidence:
    """Pool N instances by class, with a logical OR over the pairs of their instances."""
    distinct, _, row, counts, _ = pool_classes(classes, np.ones(len(classes)))
    holds, observed = pool_relations(row, len(distinct), holds, observed)
    return ClassEvidence(distinct, counts, holds, observed)


@dataclass(frozen=True, slots=True, eq=False)
class EncodedScene:
    """One scene, encoded with a vocabulary."""

    scene_id: str
    source: str
    group: str
    room_type: int  # index, -1 if unknown
    evidence: ClassEvidence  # classes, and relations between classes
    instance_classes: Int[NDArray, "N"]
    instance_holds: Bool[NDArray, "A N N"]
    instance_observed: Bool[NDArray, "A N N"]
    unknown: tuple[str, ...]  # distinct labels outside the vocabulary, sorted; they are left out
    instance_stands: Int[NDArray, "N"]  # what carries each instance; see `app.scene.stands`
    # Boxes in the viewer axes of the relations. NaN: unknown; None: relations without positions.
    instance_positions: Float[NDArray, "N 3"] | None = None  # centres in metres
    instance_sizes: Float[NDArray, "N 3"] | None = None  # extents before the rotation in metres
    instance_yaws: Float[NDArray, "N"] | None = None  # rotations about the z axis in radians
    weight: float = 1.0  # in the training of objects
    complete: bool = True  # the object list is nearly complete; see `Meaning`

    def only(self, kept: Bool[NDArray, "N"]) -> EncodedScene:
        """Return the scene with only some of its instances."""
        index = np.flatnonzero(kept)
        names = ("classes", "stands", "positions", "sizes", "yaws")
        arrays = {f"instance_{name}": getattr(self, f"instance_{name}") for name in names}
        arrays = {name: None if array is None else array[index] for name, array in arrays.items()}
        tables = (self.instance_holds, self.instance_observed)
        holds, observed = (table[:, index][:, :, index] for table in tables)
        evidence = pool_instances(arrays["instance_classes"], holds, observed)
        arrays |= {"instance_holds": holds, "instance_observed": observed}
        return replace(self, evidence=evidence, **arrays)


def encode(
    scenes: Iterable[AnnotatedScene], vocabulary: Vocabulary, roles: RoleCounts | None = None
) -> list[EncodedScene]:
    """Encode scenes with a vocabulary, and the roles of classes whose boxes reach into each other.

    A relation is observed if its truth is known. Relations come from the first kind of annotation
    in this list that a scene contains:

    - Listed relations. A relation that is listed in both directions is unobserved.
    - Positions, by the rules of `app.scene.scene`. If positions are not in viewer axes,
      `room_viewpoint` chooses a viewpoint.
    - Boxes in an image, by the rule of `scene_client.image_plane`, for left and above only.
    - Support links. The object is on top of its support or inside it. All other relations of the
      pair are false. If the object reaches into its support, the roles of the two classes decide.

    `training.datasets.sources` defines which unlisted relations of a data source are false, and
    which labels are ignored. Relations of structure classes are unobserved.
    """
    scenes, index_of = list(scenes), cache(vocabulary.index)
    groups = Counter(scene.group for scene in scenes)
    encoded = []
    for scene in scenes:
        indices = [index_of(thing.label) for thing in scene.objects]
        encoded.append(_encode(scene, groups[scene.group], indices, vocabulary, roles))
    return encoded


def annotated_classes(
    scenes: Sequence[EncodedScene], vocabulary: Vocabulary
) -> dict[str, ClassMask]:
    """Return masks of the annotated classes of each source: unlisted, they are absent."""
    annotated: dict[str, ClassMask] = {}
    for scene in scenes:
        if scene.source not in annotated:
            start = source_of(scene.source).open_vocabulary
            annotated[scene.source] = np.full(len(vocabulary), start)
        annotated[scene.source][scene.instance_classes] = True
    for name, classes in annotated.items():
        source = source_of(name)
        classes[_classes_named((*source.left_out, *source.coarse), vocabulary)] = False
    return annotated


def _classes_named(labels: Iterable[str], vocabulary: Vocabulary) -> list[int]:
    """Return the classes with these labels, without names that are only an alias."""
    return [vocabulary.labels.index(label) for label in labels if label in vocabulary.labels]


def _encode(
    scene: AnnotatedScene,
    group_size: int,
    matches: Sequence[int | None],
    vocabulary: Vocabulary,
    roles: RoleCounts | None,
) -> EncodedScene:
    """Encode one scene of a group of `group_size` scenes; `matches` are classes of its objects."""
    meaning = meaning_of(scene.source, listed=scene.relations is not None)
    left_out = _classes_named(source_of(scene.source).left_out, vocabulary)
    kept = [i for i, c in enumerate(matches) if c is not None and c not in left_out]
    indices = np.array([-1 if c is None else c for c in matches], dtype=np.int64)
    relations, boxes = _relations(scene, meaning, indices, roles)
    structure = (indices >= 0) & vocabulary.structure[indices]
    stands = _stands(scene, relations, boxes, structure)[kept]
    holds = relations.holds[:, kept][:, :, kept]
    observed = relations.observed[:, kept][:, :, kept]
    classes = indices[kept]
    # Relations of structure classes are uninformative: every room has walls on all sides.
    for array in (holds, observed):
        array[:, structure[kept]] = array[:, :, structure[kept]] = False
    room_type = curated_names().room_index(scene.room_type, vocabulary)
    evidence = pool_instances(classes, holds, observed)
    # One object entry can mean several instances.
    counts, numbers = np.zeros_like(evidence.counts), [scene.objects[i].count for i in kept]
    np.add.at(counts, np.searchsorted(evidence.classes, classes), numbers)
    labels = [thing.label for thing, c in zip(scene.objects, matches, strict=True) if c is None]
    return EncodedScene(
        scene_id=scene.scene_id,
        source=scene.source,
        group=scene.group,
        room_type=-1 if room_type is None else room_type,
        evidence=replace(evidence, counts=counts),
        instance_classes=classes,
        instance_holds=holds,
        instance_observed=observed,
        instance_stands=stands,
        # One spelling of each label without a class.
        unknown=tuple(sorted({label_key(label): label for label in labels}.values())),
        instance_positions=None if boxes is None else boxes[kept, :3],
        instance_sizes=None if boxes is None else boxes[kept, 3:6],
        instance_yaws=None if boxes is None else boxes[kept, 6],
        weight=min(1.0, (meaning.scenes_per_group or group_size) / group_size),
        complete=meaning.complete_objects,
    )


def _stands(
    scene: AnnotatedScene,
    relations: PoseRelations,
    boxes: Float[NDArray, "N 7"] | None,
    structure: Bool[NDArray, "N"],
) -> Int[NDArray, "N"]:
    """Return what carries each object of a scene; see `app.scene.stands`."""
    if boxes is not None:
        heights = Heights.of(boxes[:, :3], boxes[:, 3:6])
        if np.isfinite(heights.bottoms).any():
            floor = float(np.nanmin(heights.bottoms))
            stands = stands_of(relations.holds, relations.observed, heights, floor=floor)
            stands[[thing.supported_by is not None for thing in scene.objects]] = SUPPORTED
            return stands
    stands = np.full(len(scene.objects), UNKNOWN)
    # A listed support that is neither the floor nor an object is a wall.
    stands[[*scene.supported]] = HANGS
    supports: Bool[NDArray, "N N"] = np.any(relations.holds[[*SUPPORTS]], axis=0)
    stands[supports[:, structure].any(1)] = FLOOR
    stands[supports[:, ~structure].any(1)] = SUPPORTED
    return stands


def _relations(
    scene: AnnotatedScene, meaning: Meaning, classes: Int[NDArray, "N"], roles: RoleCounts | None
) -> tuple[PoseRelations, Float[NDArray, "N 7"] | None]:
    """Return all relations, and the boxes (position, size, yaw) of scenes with positions."""
    n, boxes = len(scene.objects), None
    if scene.relations is not None:
        return _from_lists(scene, scene.relations, meaning), None
    if any(thing.position is not None for thing in scene.objects):
        relations, boxes = _from_poses(scene, classes, roles)
        _apply_rules(relations, scene.objects, meaning)
    elif any(thing.box2d is not None for thing in scene.objects):
        relations = derive_from_boxes([thing.box2d or (math.nan,) * 4 for thing in scene.objects])
    else:
        relations = PoseRelations(np.zeros((A, n, n), np.float32), np.zeros((A, n, n), np.bool_))
    _add_supports(relations, scene.objects, classes, roles)
    for subject, relation, anchor in scene.false_relations:
        denied = canonicalise(subject, relation, anchor)
        relations.probability[denied], relations.observed[denied] = 0.0, True
    return relations, boxes


def _from_lists(
    scene: AnnotatedScene, listed: Sequence[tuple[int, str, int]], meaning: Meaning
) -> PoseRelations:
    """Combine listed relations, denied relations, and the source's rule for unlisted relations."""
    n = len(scene.objects)
    holds, denied = np.zeros((2, A, n, n), dtype=np.bool_)
    for relations, array in ((listed, holds), (scene.false_relations, denied)):
        for subject, relation, anchor in relations:
            array[canonicalise(subject, relation, anchor)] = True
    # Contradictory annotations are unobserved: both directions listed, or listed and denied.
    is_contradicted = (holds & holds.swapaxes(1, 2)) | (holds & denied)
    is_related = holds.any(0)
    supported = np.isin(np.arange(n), scene.supported)
    masks = {
        "off": np.ones((n, n), dtype=np.bool_),
        "off for supported": np.repeat(supported[:, None], n, axis=1),
        "off for neighbours": is_related | is_related.T,
        "unobserved": np.zeros((n, n), dtype=np.bool_),
    }
    holds &= ~is_contradicted
    observed = np.stack([masks[kind] for kind in meaning.unlisted]) | holds | denied
    is_stacked = holds[[*STACKED]].any(0)
    observed |= is_stacked | is_stacked.T
    observed &= ~is_contradicted & ~np.eye(n, dtype=np.bool_)
    return PoseRelations(holds.astype(np.float32), observed)


def _apply_rules(
    relations: PoseRelations, objects: Sequence[AnnotatedObject], meaning: Meaning
) -> None:
    """Apply the source's rule for unlisted relations; sizes show all stacks but open roles."""
    located = np.array([thing.position is not None for thing in objects])
    pairs = located[:, None] & located & ~np.eye(len(objects), dtype=np.bool_)
    for relation, unlisted in enumerate(meaning.unlisted):
        if unlisted == "off" and relation not in STACKED:
            relations.observed[relation] |= pairs
        elif unlisted == "unobserved":
            relations.observed[relation] &= relations.holds[relation]


def _from_poses(
    scene: AnnotatedScene, classes: Int[NDArray, "N"], roles: RoleCounts | None
) -> tuple[PoseRelations, Float[NDArray, "N 7"]]:
    """Derive relations from positions in viewer axes. Return them and the boxes."""
    unknown = (math.nan,) * 3
    positions = np.array([thing.position or unknown for thing in scene.objects])
    sizes = np.array([thing.size or unknown for thing in scene.objects])
    yaws = np.array([thing.yaw for thing in scene.objects])
    if not scene.viewer_frame:
        viewpoint = room_viewpoint(scene.scene_id, positions)
        positions, yaws = to_viewer_frame(positions, viewpoint, yaws)
    boxes = np.column_stack([positions, sizes, yaws])
    return derive_relations(positions, sizes, yaws, classes=classes, roles=roles), boxes


def _add_supports(
    relations: PoseRelations,
    objects: Sequence[AnnotatedObject],
    classes: Int[NDArray, "N"],
    roles: RoleCounts | None,
) -> None:
    """Set on-top or inside for each support link; see `encode`."""
    index_of = {thing.id: index for index, thing in enumerate(objects)}
    for index, thing in enumerate(objects):
        if thing.supported_by is None or (support := index_of[thing.supported_by]) == index:
            continue
        pair = [index, support], [support, index]
        relations.probability[:, *pair], relations.observed[:, *pair] = 0.0, True
        lift = lift_of(thing, objects[support])
        role = ON
        if roles is not None and lift is not None and lift < -CONTACT:
            role = likely_role(roles, classes[index], classes[support], _SUPPORTED)
        if role >= 0:
            relations.probability[ON_TOP if role == ON else INSIDE, index, support] = 1.0
        else:
            relations.observed[[*SUPPORTS], index, support] = False


def room_viewpoint(scene_id: str, positions: Float[NDArray, "N 3"]) -> Viewpoint:
    """Return a viewpoint at one side of the box of the object centres (metres), facing inwards."""
    (x0, y0), (x1, y1) = np.nanmin(positions[:, :2], 0), np.nanmax(positions[:, :2], 0)
    # A hash never changes the side of a scene, and over many scenes all four sides occur.
    side = hashlib.sha256(scene_id.encode()).digest()[0] % 4
    return side_viewpoints(float(x0), float(y0), float(x1), float(y1))[side]


def side_viewpoints(x0: float, y0: float, x1: float, y1: float) -> tuple[Viewpoint, ...]:
    """Return the viewpoints at the middle of the four sides of a room, facing inwards."""
    x, y = (x0 + x1) / 2, (y0 + y1) / 2
    return (
        Viewpoint(x0, y, 0.0),
        Viewpoint(x, y0, math.pi / 2),
        Viewpoint(x1, y, math.pi),
        Viewpoint(x, y1, -math.pi / 2),
    )


def derive_from_boxes(boxes: Sequence[Box2d]) -> PoseRelations:
    """Derive left and above between image boxes by `scene_client.image_plane`; NaN means no box."""
    holds, observed = np.zeros((2, A, len(boxes), len(boxes)), dtype=np.bool_)
    for i, j in itertools.combinations(range(len(boxes)), 2):
        if are_neighbours(boxes[i], boxes[j]):
            observed[_IN_THE_IMAGE, i, j] = observed[_IN_THE_IMAGE, j, i] = True
            if (relation := relation_between(boxes[i], boxes[j])) is not None:
                holds[canonicalise(i, relation, j)] = True
    return PoseRelations(holds.astype(np.float32), observed)
