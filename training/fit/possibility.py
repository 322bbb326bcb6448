"""Fit the prior of possibility (`app.model.possibility`) to stated supports and to boxes.

The examples are pairs of classes in a scene. A pair of a listed relation or of a support link is
possible if two scenes state it. Any other pair is a counter-example if a scene shows that the
relation does not hold. Sources for research take no part.

Few own scenes show too few pairs. Then the weights are those of the written places
(`training.datasets.inventories`): what can stand on what is the same everywhere.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from functools import cache
from typing import Final

import numpy as np
from jaxtyping import Float
from numpy.typing import NDArray

from app.model.possibility import (
    FEATURES,
    IN,
    ON,
    OVER,
    UNDER,
    Possibility,
    features,
)
from app.scene import CANONICAL, Vocabulary, label_key
from app.scene.scene import CONTACT
from app.scene.spatial_relations import ABOVE, INSIDE, ON_TOP
from training.datasets import EncodedScene, encode
from training.datasets.inventories import Thing, complete_scene, shipped_inventory
from training.datasets.records import AnnotatedScene
from training.datasets.roles import lift_of
from training.datasets.sources import source_of
from training.datasets.written import written_vocabulary
from training.fit.regression import logistic

Floats = NDArray[np.float64]

_LEAST_SHOWN: Final = 2  # scenes that show a possible pair
_LEAST_PAIRS: Final = 200  # possible pairs of the scenes that suffice for a fit
_SPREAD: Final = 0.25  # standard deviation of log sizes without a description
_QUANTILE: Final = 1.28  # a large thing is larger than 90 % of all
_NARROWEST: Final = 0.1  # minimum standard deviation of log sizes
_LEVELS: Final = {"no": 0.0, "sometimes": 0.5, "yes": 1.0}
_CARRIERS: Final = {"hand": 0.0, "hands": 1.0, "people": 2.0, "no": 3.0}
_PLACES: Final = ("floor", "wall", "ceiling", "surface", "inside")

# Place, and whether the subject of the relation is at this place. A relation of a place without
# the object, such as left, is none.
_STATED: Final = {
    "on-top": (ON, True), "under": (UNDER, True), "above": (OVER, True), "below": (OVER, False),
    "inside": (IN, True), "contains": (IN, False),
}  # fmt: skip
# Relation that does not hold if a place is impossible, and whether its subject is at the place.
_DENIED: Final = {
    ON: (ON_TOP, True),
    UNDER: (ON_TOP, False),
    OVER: (ABOVE, True),
    IN: (INSIDE, True),
}

_NEUTRAL: Final = np.zeros((4, FEATURES))

Pair = tuple[int, int, int]  # place, class at this place, and class of the other object


def describe(
    vocabulary: Vocabulary, things: Mapping[str, Thing], weights: Float[Floats, "4 features"]
) -> Possibility:
    """Return the descriptions of the classes; without a row, a class has that of its parent."""
    rows = _rows(vocabulary, things)
    V = len(rows)
    stands, traits = np.full((V, len(_PLACES)), 1 / len(_PLACES)), np.full((V, 3), -1.0)
    spread = np.full(V, _SPREAD)
    for k, thing in enumerate(rows):
        if thing is not None:
            stands[k] = [thing.stands.get(place, 0.0) for place in _PLACES]
            levels = _LEVELS[thing.surface], _LEVELS[thing.container]
            traits[k] = *levels, _CARRIERS[thing.carried]
            spread[k] = max(math.log(thing.large) / _QUANTILE, _NARROWEST)
    tables = (array.astype(np.float32) for array in (stands, traits, spread, weights))
    return Possibility(*tables)


def _rows(vocabulary: Vocabulary, things: Mapping[str, Thing]) -> list[Thing | None]:
    """Return the thing of each class, by its label or its other names, or of its parent."""
    described = {label_key(thing.label): thing for thing in things.values()}
    for thing in things.values():
        for name in thing.other_names:
            described.setdefault(label_key(name), thing)
    own = [
        next(filter(None, (described.get(label_key(n)) for n in (c.label, *c.aliases))), None)
        for c in vocabulary.objects
    ]
    rows = list(own)
    for k, parent in enumerate(vocabulary.parents.tolist()):
        while rows[k] is None and parent >= 0:
            rows[k], parent = own[parent], int(vocabulary.parents[parent])
    return rows


def fit_possibility(
    annotated: Sequence[AnnotatedScene],
    encoded: Sequence[EncodedScene],  # the same scenes
    vocabulary: Vocabulary,
    things: Mapping[str, Thing],  # descriptions, by label
) -> Possibility | None:
    """Describe the classes, and fit the weights to scenes; None if no class has a description.

    If the scenes show too few possible pairs, the weights are those of the written places.
    """
    prior = describe(vocabulary, things, _NEUTRAL)
    if not prior.is_described.any():
        return None
    possible = stated_pairs(annotated, vocabulary)
    if sum(place == ON for place, *_ in possible) < _LEAST_PAIRS:
        weights = _written_weights()
    else:
        weights = _fit_weights(prior, vocabulary, possible, denied_pairs(encoded, vocabulary))
    # Artifacts store tables in half precision.
    stands, weights = (x.astype(np.float16).astype(np.float32) for x in (prior.stands, weights))
    return replace(prior, stands=stands, weights=weights)


@cache
def _written_weights() -> Float[NDArray[np.float32], "4 features"]:
    """Fit the weights to the written places of the repository, in two seconds.

    Parts of them show what does not stand at a place, because complete ones show a million pairs.
    """
    vocabulary, inventory = written_vocabulary(), shipped_inventory()
    possible = stated_pairs(map(complete_scene, inventory.places), vocabulary)
    impossible = denied_pairs(encode(inventory.detected_scenes(1, seed=0), vocabulary), vocabulary)
    prior = describe(vocabulary, inventory.things, _NEUTRAL)
    return _fit_weights(prior, vocabulary, possible, impossible)


def _fit_weights(
    prior: Possibility,
    vocabulary: Vocabulary,
    possible: Counter[Pair],
    impossible: Counter[tuple[int, int, int]],
) -> Float[NDArray[np.float32], "4 features"]:
    """Fit the weights of all places; 0 for a place without examples of both kinds."""
    places = [_fit_place(prior, vocabulary, place, possible, impossible) for place in range(4)]
    return np.stack(places).astype(np.float32)


def stated_pairs(scenes: Iterable[AnnotatedScene], vocabulary: Vocabulary) -> Counter[Pair]:
    """Count the scenes that state each pair of classes at a place, without structure."""
    index, counts = cache(vocabulary.index), Counter[Pair]()
    for scene in scenes:
        if source_of(scene.source).research_only:
            continue
        classes = [index(thing.label) for thing in scene.objects]
        pairs = ((place, classes[i], classes[j]) for place, i, j in _placed(scene))
        counts.update(
            {
                (place, i, j)
                for place, i, j in pairs
                if i is not None
                and j is not None
                and i != j
                and not vocabulary.structure[[i, j]].any()
            }
        )
    # A single scene may be an error.
    return Counter({pair: n for pair, n in counts.items() if n >= _LEAST_SHOWN})


def _placed(scene: AnnotatedScene) -> Iterator[tuple[int, int, int]]:
    """Yield the places that a scene states by relations and by links of supports."""
    for subject, relation, anchor in scene.relations or ():
        if relation in _STATED:
            place, outgoing = _STATED[relation]
            yield (place, subject, anchor) if outgoing else (place, anchor, subject)
    numbers = {thing.id: k for k, thing in enumerate(scene.objects)}
    for k, thing in enumerate(scene.objects):
        if thing.supported_by is not None and (support := numbers[thing.supported_by]) != k:
            lift = lift_of(thing, scene.objects[support])
            yield (ON if lift is None or lift >= -CONTACT else IN), k, support


def denied_pairs(
    scenes: Iterable[EncodedScene], vocabulary: Vocabulary
) -> Counter[tuple[int, int, int]]:
    """Count the scenes that show each relation (canonical, two classes) not to hold."""
    V, blocks = len(vocabulary), [np.zeros(0, np.int64)]
    for scene in scenes:
        if source_of(scene.source).research_only:
            continue
        evidence = scene.evidence
        a, i, j = np.nonzero((evidence.observed & ~evidence.holds)[ON_TOP:])
        i, j = evidence.classes[i], evidence.classes[j]
        blocks.append((((a + ON_TOP) * V + i) * V + j)[i != j])
    keys, counts = np.unique(np.concatenate(blocks), return_counts=True)
    triples = np.unravel_index(keys, (len(CANONICAL), V, V))
    columns = (column.tolist() for column in (*triples, counts))
    return Counter({(a, i, j): n for a, i, j, n in zip(*columns, strict=True)})


def _fit_place(
    prior: Possibility,
    vocabulary: Vocabulary,
    place: int,
    possible: Counter[Pair],
    impossible: Counter[tuple[int, int, int]],
) -> Float[Floats, " features"]:
    """Fit the weights of one place. Both kinds of examples have the same total weight."""
    relation, outgoing = _DENIED[place]
    # A relation that some scene shows is possible. "Under" is the opposite of on-top.
    seen = {(i, j) for p, i, j in possible if p == place}
    right = {(i, j): n for (p, i, j), n in possible.items() if p == place}
    wrong = {
        pair: n
        for (a, i, j), n in impossible.items()
        if a == relation
        and (pair := (i, j) if outgoing else (j, i)) not in seen
        and not (place == ON and (UNDER, pair[1], pair[0]) in possible)
    }
    pairs = np.array([*right, *wrong], np.int64).reshape(-1, 2)
    counts = np.log1p(np.array([*right.values(), *wrong.values()], float))
    truth = np.arange(len(pairs)) < len(right)
    weight = counts / np.where(truth, counts[truth].sum(), counts[~truth].sum()) * len(right)
    known = prior.is_described[pairs].all(1)
    if not (known & truth).any() or not (known & ~truth).any():
        return np.zeros(FEATURES)
    things, others = (prior.rows(of, vocabulary.sizes[of]) for of in pairs[known].T)
    phi, truth, weight = features(place, things, others), truth[known], weight[known]
    used, weights = np.ones(FEATURES, np.bool_), np.zeros(FEATURES)
    while used.any():
        *fitted, _ = logistic(-phi[:, used], truth, weight)
        if min(fitted) >= 0:
            weights[used] = fitted
            break
        used[used] = np.array(fitted) > 0  # no feature makes a place more possible
    return weights
