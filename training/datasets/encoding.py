"""Annotated scenes to what a model sees: class indices and observed relations."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from app.scene import (
    CANONICAL,
    ClassEvidence,
    PoseRelations,
    Vocabulary,
    canonicalise,
    derive_relations,
    label_key,
    pool_instances,
    to_viewer_frame,
)
from training.datasets.image_plane import derive_from_boxes
from training.datasets.names import Names, curated_names
from training.datasets.records import AnnotatedObject, AnnotatedScene
from training.datasets.viewpoints import room_viewpoint

A = len(CANONICAL)
_ON_TOP: Final = CANONICAL.index("on-top")

# Labels that a source annotates so incompletely that they say nothing there.
LEFT_OUT: Final[dict[str, tuple[str, ...]]] = {"sunrgbd": ("wall", "floor")}

# Sources annotated in free words: a class that they never mention was not there. In the others the
# annotator chose from a list, and a class that is not on it is unobserved.
OPEN_VOCABULARY: Final = frozenset({"sunrgbd"})


@dataclass(frozen=True, slots=True, eq=False)
class EncodedScene:
    """One scene in terms of a vocabulary; N instances, A canonical relations.

    Attributes:
        scene_id, source, group: as annotated.
        room_type: index of the room type, -1 where none is known.
        evidence: the classes of the scene and their relations.
        instance_classes: (N,) int64, the class of each instance.
        instance_holds: (A, N, N) bool, relations between instances.
        instance_observed: (A, N, N) bool, whether they were observed, on or off.
        unknown: distinct labels outside the vocabulary, which are left out.
        instance_positions: (N, 3) centres in metres in the viewer axes that the relations were
            derived in, NaN where unknown; None where relations do not come from positions.
    """

    scene_id: str
    source: str
    group: str
    room_type: int
    evidence: ClassEvidence
    instance_classes: NDArray[np.int64]
    instance_holds: NDArray[np.bool_]
    instance_observed: NDArray[np.bool_]
    unknown: int
    instance_positions: NDArray[np.float64] | None = None


def encode(scenes: Iterable[AnnotatedScene], vocabulary: Vocabulary) -> list[EncodedScene]:
    """Encode scenes.

    What is observed depends on how a scene was annotated:

    - relations by people: every pair of instances; what is not listed is off, in the sense that the
      annotator would not list it; what is listed both ways round is unobserved;
    - positions: what `app.scene.geometry` derives, from `room_viewpoint` where the axes are not a
      viewer's; support links count as on-top, and then nothing else holds of the pair;
    - boxes in an image: what `training.datasets.image_plane` derives;
    - otherwise support links alone, or nothing.

    Relations of structure classes are dropped: neither on nor off. Labels in `LEFT_OUT` are treated
    as if they had not been annotated.
    """
    encoder = _Encoder(vocabulary, curated_names())
    return [encoder(scene) for scene in scenes]


def annotated_classes(
    scenes: Sequence[EncodedScene], vocabulary: Vocabulary
) -> dict[str, NDArray[np.bool_]]:
    """Per source, (V,) the classes whose absence from a scene means something.

    These are the classes that the source ever mentions, or all of them in a source of open
    vocabulary, less those in `LEFT_OUT`. Initial biases are frequencies over the sources that
    mention a class, and generated scenes are compared in these.
    """
    annotated: dict[str, NDArray[np.bool_]] = {}
    for scene in scenes:
        if scene.source not in annotated:
            start = scene.source in OPEN_VOCABULARY
            annotated[scene.source] = np.full(len(vocabulary), start)
        annotated[scene.source][scene.instance_classes] = True
    for source, labels in LEFT_OUT.items():
        for index in map(vocabulary.index, labels):
            if source in annotated and index is not None:
                annotated[source][index] = False
    return annotated


class _Encoder:
    def __init__(self, vocabulary: Vocabulary, names: Names) -> None:
        self.vocabulary = vocabulary
        self.names = names
        self.indices: dict[str, int | None] = {}
        self.left_out = {
            source: frozenset(vocabulary.index(label) for label in labels)
            for source, labels in LEFT_OUT.items()
        }

    def __call__(self, scene: AnnotatedScene) -> EncodedScene:
        left_out = self.left_out.get(scene.source, frozenset())
        classes = [self._index(thing.label) for thing in scene.objects]
        kept = [i for i, c in enumerate(classes) if c is not None and c not in left_out]
        relations, positions = _relations(scene)
        holds = relations.holds[:, kept][:, :, kept]
        observed = relations.observed[:, kept][:, :, kept]
        instance_classes = np.array([classes[i] for i in kept], dtype=np.int64)
        # A wall is in every room and left of everything: its relations teach nothing.
        structure = self.vocabulary.structure[instance_classes]
        for array in (holds, observed):
            array[:, structure] = False
            array[:, :, structure] = False
        room = self.names.canonical_room(scene.room_type)
        room_type = None if room is None else self.vocabulary.room_index(room)
        return EncodedScene(
            scene_id=scene.scene_id,
            source=scene.source,
            group=scene.group,
            room_type=-1 if room_type is None else room_type,
            evidence=pool_instances(
                instance_classes, np.ones(len(kept)), holds, observed, room_type
            ),
            instance_classes=instance_classes,
            instance_holds=holds,
            instance_observed=observed,
            unknown=len(
                {
                    label_key(thing.label)
                    for thing, index in zip(scene.objects, classes, strict=True)
                    if index is None
                }
            ),
            instance_positions=None if positions is None else positions[kept],
        )

    def _index(self, label: str) -> int | None:
        if label not in self.indices:
            self.indices[label] = self.vocabulary.index(label)
        return self.indices[label]


def _relations(scene: AnnotatedScene) -> tuple[PoseRelations, NDArray[np.float64] | None]:
    """Relations between all instances of a scene, by the best annotation there is.

    Returns:
        Them, and the positions (n, 3) that they were derived from, if they were.
    """
    n = len(scene.objects)
    positions = None
    if scene.relations is not None:
        holds = np.zeros((A, n, n), dtype=np.bool_)
        for subject, relation, anchor in scene.relations:
            holds[canonicalise(subject, relation, anchor)] = True
        # Who says that each is in front of the other has said nothing.
        both = holds & holds.swapaxes(1, 2)
        return PoseRelations(holds & ~both, ~both & ~np.eye(n, dtype=np.bool_)), None
    if any(thing.position is not None for thing in scene.objects):
        found, positions = _from_poses(scene)
    elif any(thing.box2d is not None for thing in scene.objects):
        boxes = [thing.box2d or (math.nan,) * 4 for thing in scene.objects]
        found = derive_from_boxes(boxes)
    else:
        nothing = np.zeros((A, n, n), dtype=np.bool_)
        found = PoseRelations(nothing, nothing.copy())
    _add_supports(found, scene.objects)
    return found, positions


def _from_poses(scene: AnnotatedScene) -> tuple[PoseRelations, NDArray[np.float64]]:
    unknown = (math.nan,) * 3
    positions = np.array([thing.position or unknown for thing in scene.objects])
    sizes = np.array([thing.size or unknown for thing in scene.objects])
    yaws = np.array([thing.yaw for thing in scene.objects])
    if not scene.viewer_frame:
        viewpoint = room_viewpoint(scene.scene_id, positions)
        positions, yaws = to_viewer_frame(positions, viewpoint, yaws)
    return derive_relations(positions, sizes, yaws), positions


def _add_supports(found: PoseRelations, objects: Sequence[AnnotatedObject]) -> None:
    """What lies in a drawer is on its dresser, whatever the boxes say."""
    place = {thing.id: index for index, thing in enumerate(objects)}
    for index, thing in enumerate(objects):
        if thing.supported_by is None or (support := place[thing.supported_by]) == index:
            continue
        for i, j in ((index, support), (support, index)):
            found.holds[:, i, j] = False
            found.observed[:, i, j] = True
        found.holds[_ON_TOP, index, support] = True
