"""Turn scenes into test questions: choose the parts of a scene to state, hide or alter.

The random choices depend only on the seed and the scene id, so every model has the same questions.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Collection, Sequence
from dataclasses import dataclass
from typing import Final, NamedTuple, TypeAlias
from zlib import crc32

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from numpy.typing import NDArray

from app.scene import CANONICAL, RelationTable, Scene, SceneObject, Vocabulary
from app.scene.spatial_relations import ABOVE, LATERAL, STACKED
from training.datasets import EncodedScene
from training.datasets.array_types import ClassMask, Rng, Table
from training.datasets.batches import SceneTensors, subset
from training.datasets.sources import meaning_of, source_of

Triple: TypeAlias = tuple[int, int, int]

_MOST_TRIPLES: Final = 40
_ATTEMPTS: Final = 50  # random changes of a triple that are tried

MOST: Final = 12
"""Maximum distinguished number of instances. It also stands for larger numbers."""

_LISTED: Final = (0.25, 0.5, 0.75, 1.0)


def scene_rng(scene: EncodedScene, seed: int) -> Rng:
    """Return the random generator of one scene, from the seed and the id of the scene."""
    return np.random.default_rng([seed, crc32(scene.scene_id.encode())])


def some_scenes(scenes: SceneTensors, limit: int | None, seed: int = 0) -> SceneTensors:
    """Return at most `limit` scenes in their order, drawn by the seed and their names."""
    if limit is None or len(scenes) <= limit:
        return scenes
    order = [crc32(f"{seed} {scene.source} {scene.scene_id}".encode()) for scene in scenes.scenes]
    return subset(scenes, torch.from_numpy(np.sort(np.argsort(order, kind="stable")[:limit])))


def scene_of(encoded: EncodedScene, kept: Sequence[int], triples: Sequence[Triple]) -> Scene:
    """Return a scene, in the form of a request, with the object instances at the indices `kept`."""
    objects = tuple(
        SceneObject(id=str(k), label=str(c), class_index=int(c))
        for k, c in enumerate(encoded.instance_classes[list(kept)])
    )
    room = encoded.room_type
    table = RelationTable.stated(triples) if triples else None
    return Scene(objects, table, room_type=room if room >= 0 else None)


def annotated_relations(encoded: EncodedScene) -> Bool[NDArray, "A N N"]:
    """Return a mask of the relations whose truth is annotated without selection bias.

    The source must also show that a relation does not hold: sentences do for left and front of
    stacked objects, and boxes for left and front, but no camera frame, and boxes not for above
    (docs/decisions/relations.md).
    """
    positions, of_one_view = encoded.instance_positions, source_of(encoded.source).of_one_view
    annotated = encoded.instance_observed.copy()
    stacked = encoded.instance_holds[[*STACKED]].any(0)  # pairs, in both directions
    stacked |= stacked.T
    # `unlisted` is the meaning of an unlisted relation a of the source, such as "off" (false).
    for a, unlisted in enumerate(meaning_of(encoded.source, listed=positions is None).unlisted):
        if a in LATERAL and positions is not None and unlisted != "unobserved":
            # Positions show left and front of every pair. Those of a camera frame do not count.
            located: Bool[NDArray, "N"] = np.all(np.isfinite(positions), axis=1)
            annotated[a] = located[:, None] & located & ~np.eye(len(located), dtype=np.bool_)
            annotated[a] &= not of_one_view
        elif unlisted not in ("off", "off for supported") or (a == ABOVE and positions is not None):
            # Only true relations are annotated, except left and front of stacked objects.
            annotated[a] &= stacked & (a in LATERAL)
    return annotated


def removed_class(
    encoded: EncodedScene, structure: ClassMask, rng: Rng
) -> tuple[int, list[int]] | None:
    """Draw a class to remove, without structure. Return it and the instances of others."""
    classes = encoded.evidence.classes
    removable = classes[~structure[classes]]
    if len(removable) < 2:
        return None
    target = int(rng.choice(removable))
    return target, np.flatnonzero(encoded.instance_classes != target).tolist()


def observed_pairs(
    encoded: EncodedScene, structure: ClassMask, rng: Rng
) -> tuple[Bool[NDArray, "N N"], list[Triple]]:
    """Draw half of the pairs as observed. Return the unobserved pairs and the observed triples."""
    # If relations were drawn, pairs without an observed relation would have fewer than others.
    size = len(encoded.instance_classes)
    half = np.triu(rng.random((size, size)) < 0.5, 1)
    observed = half | half.T
    return ~observed, _triples(encoded.instance_holds & observed, encoded, structure)


def _triples(
    holds: Bool[NDArray, "A N N"], encoded: EncodedScene, structure: ClassMask
) -> list[Triple]:
    """Return the triples (relation, subject, object) of instances without structure."""
    is_thing = ~structure[encoded.instance_classes]
    triples = np.argwhere(holds & is_thing[:, None] & is_thing)
    return [(a, i, j) for a, i, j in triples.tolist()]


class Part(NamedTuple):
    """A part of a scene that a robot could list."""

    classes: Int[NDArray, "n"]  # listed classes without structure, in ascending order
    listed: Int[NDArray, "n"]  # number of listed instances of each class, from 1 to `number`
    number: Int[NDArray, "n"]  # instances of each class in the scene, at most `MOST`
    room: int  # index of the room type, -1 if unknown


def some_instances(encoded: EncodedScene, structure: ClassMask, rng: Rng) -> Part:
    """Draw a part to list: 25, 50, 75 or 100 % of the classes, with one or more instances."""
    things = np.flatnonzero(~structure[encoded.evidence.classes])
    count = max(1, int(_LISTED[rng.integers(len(_LISTED))] * len(things) + 0.5))
    index = np.sort(rng.permutation(things)[:count])
    number = np.minimum(encoded.evidence.counts[index], MOST)
    listed = np.ones_like(number) if rng.random() < 0.5 else rng.integers(1, number + 1)
    room = encoded.room_type if rng.random() < 0.5 else -1
    return Part(encoded.evidence.classes[index], listed, number, room)


def occupied_place(
    encoded: EncodedScene,
    structure: ClassMask,
    shown: Bool[NDArray, "N"],
    rng: Rng,
    relations: Collection[int],
) -> tuple[int, int] | None:
    """Draw a place with an object: one of the `relations` and its shown anchor."""
    # With hidden objects alone, a missing object would seem more likely at every place.
    is_thing = ~structure[encoded.instance_classes]
    holds = encoded.instance_holds & annotated_relations(encoded)
    places = np.argwhere((holds & is_thing[:, None] & (is_thing & shown)).any(1))
    places = places[np.isin(places[:, 0], list(relations))]
    if not len(places):
        return None
    relation, anchor = places[rng.integers(len(places))]
    return int(relation), int(anchor)


def altered_case(
    encoded: EncodedScene, structure: ClassMask, rng: Rng
) -> tuple[Scene, Triple | None] | None:
    """Draw a scene with observed relations. With probability 1/2, one of them is false."""
    true_triples = draw_true_relations(encoded, structure, rng)
    if true_triples is None:
        return None
    if rng.random() < 0.5:
        return scene_of(encoded, range(len(encoded.instance_classes)), true_triples), None
    return altered_scene(encoded, structure, true_triples, rng)


def draw_true_relations(
    encoded: EncodedScene, structure: ClassMask, rng: Rng
) -> list[Triple] | None:
    """Draw at most 40 true triples without structure; None if there are fewer than two."""
    triples = _triples(encoded.instance_holds, encoded, structure)
    if len(triples) > _MOST_TRIPLES:
        drawn = np.sort(rng.choice(len(triples), _MOST_TRIPLES, replace=False))
        triples = [triples[k] for k in drawn]
    return triples if len(triples) > 1 else None


def altered_scene(
    encoded: EncodedScene, structure: ClassMask, triples: Sequence[Triple], rng: Rng
) -> tuple[Scene, Triple] | None:
    """Replace a random triple by a false one. Return the scene and the false triple."""
    is_thing = ~structure[encoded.instance_classes]
    holds = encoded.instance_holds
    index = int(rng.integers(len(triples)))
    for _ in range(_ATTEMPTS):
        relation, subject, object_ = triples[index]
        if rng.random() < 0.5:
            relation = int(rng.integers(len(CANONICAL)))
        else:
            object_ = int(rng.integers(len(is_thing)))
        # A triple is false if the scene lists neither it nor its mirror image.
        is_listed = holds[relation, subject, object_] or holds[relation, object_, subject]
        if subject == object_ or not is_thing[object_] or is_listed:
            continue
        false_triple = relation, subject, object_
        altered = [*triples[:index], false_triple, *triples[index + 1 :]]
        return scene_of(encoded, range(len(is_thing)), altered), false_triple
    return None


# Share of the classes of a scene that must occur several times. Other sources list each label once.
_COUNTING: Final = 0.05


def counted_classes(scenes: Sequence[EncodedScene], vocabulary: Vocabulary) -> dict[str, ClassMask]:
    """Return masks of the classes that each source counts. Its object lists must be complete."""
    things = ~vocabulary.structure
    entries, several = Counter[str](), Counter[str]()  # classes of scenes, those with instances > 1
    repeated: dict[str, ClassMask] = {}
    for scene in (scene for scene in scenes if scene.complete):
        evidence = scene.evidence
        is_counted = things[evidence.classes]
        entries[scene.source] += int(is_counted.sum())
        several[scene.source] += int((evidence.counts[is_counted] > 1).sum())
        is_repeated = repeated.setdefault(scene.source, np.zeros(len(vocabulary), dtype=np.bool_))
        is_repeated[evidence.classes[evidence.counts > 1]] = True
    counting = [name for name in repeated if several[name] > _COUNTING * entries[name]]
    return {
        name: things & repeated[name] if source_of(name).counts_movables else things
        for name in counting
    }


def listed_cases(
    scene: EncodedScene, counted: ClassMask, structure: ClassMask, seed: int
) -> tuple[Part, Int[NDArray, "m"]]:
    """Return a listed part of a scene, and the indices of its classes that the source counts."""
    part = some_instances(scene, structure, scene_rng(scene, seed))
    return part, np.flatnonzero(counted[part.classes])


@dataclass(frozen=True, eq=False)
class ObservedOffsets(Table):
    """Observed offsets between related objects, in metres and viewer axes."""

    offset: Float[NDArray, "N 3"]  # position of the relation's subject minus that of its object
    relation: Int[NDArray, "N"]  # canonical relation
    subject: Int[NDArray, "N"]  # class of the relation's subject
    other: Int[NDArray, "N"]  # class of the relation's object
    scene: Int[NDArray, "N"]
    source: Int[NDArray, "N"]  # data source of the scene


def observed_offsets(scenes: Sequence[EncodedScene]) -> ObservedOffsets:
    """Return the offsets between all related objects in all scenes with poses."""
    sources = sorted({scene.source for scene in scenes})
    offsets, rows = [np.zeros((0, 3))], [np.zeros((0, 5), dtype=np.int64)]
    for number, scene in enumerate(scenes):
        if scene.instance_positions is None:
            continue
        relation, i, j = np.nonzero(scene.instance_holds)
        offset = scene.instance_positions[i] - scene.instance_positions[j]
        finite = np.isfinite(offset).all(axis=1)
        classes = scene.instance_classes
        where = np.full(len(i), number), np.full(len(i), sources.index(scene.source))
        offsets.append(offset[finite])
        rows.append(np.stack([relation, classes[i], classes[j], *where], axis=1)[finite])
    return ObservedOffsets(np.concatenate(offsets), *np.concatenate(rows).T)
