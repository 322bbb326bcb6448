"""Turn scenes into test questions: choose the parts of a scene to state, hide or alter.

The random choices for a scene depend only on the seed and the scene's name. They do not depend on
the model, the other scenes or the batches. So every model gets the same questions, whether the
evaluation uses one source or all sources.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TypeAlias
from zlib import crc32

import numpy as np
import torch
from numpy.typing import NDArray
from sklearn.linear_model import LogisticRegression

from app.scene import CANONICAL, Scene, SceneObject
from training.batches import SceneTensors, subset
from training.datasets import EncodedScene
from training.datasets.sources import meaning_of

Triple: TypeAlias = tuple[int, int, int]

_VERTICAL = [CANONICAL.index("on-top"), CANONICAL.index("above")]


def scene_rng(scene: EncodedScene, seed: int) -> np.random.Generator:
    """Return the random generator of one scene."""
    return np.random.default_rng([seed, crc32(scene.scene_id.encode())])


def some_scenes(scenes: SceneTensors, limit: int | None, seed: int = 0) -> SceneTensors:
    """Return at most `limit` random scenes in their original order, the same for every model."""
    if limit is None or len(scenes) <= limit:
        return scenes
    place = [crc32(f"{seed} {scene.source} {scene.scene_id}".encode()) for scene in scenes.scenes]
    return subset(scenes, torch.from_numpy(np.sort(np.argsort(place, kind="stable")[:limit])))


def scene_of(encoded: EncodedScene, kept: Sequence[int], triples: Sequence[Triple]) -> Scene:
    """Return the instances at the indices `kept` as a scene, in the form of a request."""
    objects = tuple(
        SceneObject(id=str(k), label=str(c), class_index=int(c))
        for k, c in enumerate(encoded.instance_classes[list(kept)])
    )
    room = encoded.room_type
    return Scene(objects, tuple(triples) or None, room_type=room if room >= 0 else None)


def known_relations(encoded: EncodedScene) -> NDArray[np.bool_]:
    """Return (A, N, N) bool: True for relations with known truth, without selection bias.

    Some sources list left and front occasionally and never state that they do not hold. Such
    sources do not show how often these relations hold. For such sources, the mask contains only
    pairs with one object on or above the other. On these pairs, an unlisted left or front is false.
    """
    unlisted = meaning_of(encoded.source).unlisted
    known, holds = encoded.instance_observed.copy(), encoded.instance_holds
    stacked = holds[_VERTICAL].any(0)
    stacked |= stacked.T
    for a in range(min(len(known), len(unlisted))):
        off = known[a] & ~holds[a]
        # Without poses, "neighbours" are the pairs that an annotator chose to relate.
        chosen = unlisted[a] == "off for neighbours" and encoded.instance_positions is None
        if chosen or (unlisted[a] == "unobserved" and not (off & ~stacked).any()):
            known[a] &= stacked & off.any()
    return known


def taken_away(
    encoded: EncodedScene, structure: NDArray[np.bool_], rng: np.random.Generator
) -> tuple[int, list[int]] | None:
    """Draw a class to remove; return the class and the indices of all other instances.

    Structure classes stay in the scene. The result is None for a scene with fewer than two classes
    to draw from.
    """
    classes = encoded.evidence.classes
    removable = classes[~structure[classes]]
    if len(removable) < 2:
        return None
    target = int(rng.choice(removable))
    return target, [k for k, c in enumerate(encoded.instance_classes) if c != target]


def told_pairs(
    encoded: EncodedScene, structure: NDArray[np.bool_], rng: np.random.Generator
) -> tuple[NDArray[np.bool_], list[Triple]]:
    """Draw half of the pairs of a scene as observed.

    The draw ignores the relations of the pairs. If half of the relations were drawn instead, pairs
    without an observed relation would have fewer relations than other pairs.

    Returns:
        (N, N) bool, True for the unobserved pairs; and the observed triples.
    """
    size = len(encoded.instance_classes)
    half = np.triu(rng.random((size, size)) < 0.5, 1)
    told = half | half.T
    plain = ~structure[encoded.instance_classes]
    triples = np.argwhere(encoded.instance_holds & told & plain[:, None] & plain).tolist()
    return ~told, [(int(a), int(x), int(y)) for a, x, y in triples]


def occupied_place(
    encoded: EncodedScene,
    structure: NDArray[np.bool_],
    shown: NDArray[np.bool_],
    rng: np.random.Generator,
) -> tuple[int, int] | None:
    """Draw an occupied place beside a shown object.

    The draw ignores whether the object at the place is shown. If only places of hidden objects were
    drawn, every place would seem more likely to have a missing object.

    Args:
        shown: (n,) instances.

    Returns:
        The canonical relation of the place, and the index of the shown object, which is the object
        of the relation. None if the scene has no such place.
    """
    usable = ~structure[encoded.instance_classes]
    stands = encoded.instance_holds & known_relations(encoded) & usable[:, None] & (usable & shown)
    places = np.argwhere(stands.any(1))
    if not len(places):
        return None
    relation, anchor = places[rng.integers(len(places))]
    return int(relation), int(anchor)


def altered_case(
    encoded: EncodedScene, structure: NDArray[np.bool_], rng: np.random.Generator
) -> tuple[Scene, tuple[int, int, int] | None] | None:
    """Return a scene with its triples, and the altered triple.

    In half of the cases, a false triple replaces one of the triples. In the other half, all triples
    are true and the altered triple is None.
    """
    usable = ~structure[encoded.instance_classes]
    holds = encoded.instance_holds & usable[:, None] & usable[None, :]
    triples = [(int(a), int(i), int(j)) for a, i, j in np.argwhere(holds)]
    if len(triples) < 2:
        return None
    if len(triples) > 40:
        chosen = sorted(rng.choice(len(triples), 40, replace=False).tolist())
        triples = [triples[k] for k in chosen]
    everything = range(len(encoded.instance_classes))
    if rng.random() < 0.5:
        return scene_of(encoded, everything, triples), None
    place = int(rng.integers(len(triples)))
    for _ in range(50):
        a, i, j = triples[place]
        if rng.random() < 0.5:
            a = int(rng.integers(len(CANONICAL)))
        else:
            j = int(rng.integers(len(usable)))
        if i == j or not usable[j] or holds[a, i, j] or holds[a, j, i]:
            continue
        altered = [*triples[:place], (a, i, j), *triples[place + 1 :]]
        return scene_of(encoded, everything, altered), (a, i, j)
    return None


def logistic(
    features: NDArray[np.float64],
    truth: NDArray[np.bool_],
    weight: NDArray[np.float64] | None = None,
) -> list[float]:
    """Return coefficients and intercept of an (almost) unpenalised logistic regression."""
    fit = LogisticRegression(C=1e6, max_iter=1000).fit(features, truth, weight)
    return [float(x) for x in (*fit.coef_[0], fit.intercept_[0])]
