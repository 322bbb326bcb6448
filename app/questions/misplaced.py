"""Misplaced relations: which observed relations are wrong, and which object has moved?

An entry is an observed relation, or an object that nothing supports. There are five kinds:

    lateral   left or front
    support   an object on or in another object
    above     an object above another object
    under     an object under another object: a bin under a desk
    stand     an object that stands on the floor or hangs; it has no relation

"Under" is the opposite of on-top, so both have one unit: "the desk is on top of the bin". The words
of the request tell them apart. Otherwise the roles of the two classes do (`Places.roles`). People
also say "under" for "below", so z of such an entry is the larger of the two. An object may be above
another object if a third object supports it.

The log-odds that an entry is wrong are a weighted sum of three terms (`app.registry.Judgement`):

    z   log-odds of the relation given the objects
    d   change of these log-odds by the other observed relations
    s   log p(stand) of the object that would have moved

The stand of an object is what holds it (`app.scene.stands`). `Places.stands` has the shares S of
the floor, of the wall and of supports for the class of object i. o_ij are the odds that i is on or
in object j:

    p(floor) = S_floor    p(hangs) = S_wall    p(on or in j) = S_support · o_ij / (1 + sum_k o_ik)

The 1 stands for objects that the scene does not list. Positions and sizes show the stand of every
object. Without them, only a stated support shows the stand of its subject.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Iterator, Sequence
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from app.inference.elementary import sigmoid
from app.questions.answer import Fields, significant
from app.questions.posterior import Posterior
from app.questions.reading import Triple
from app.registry.artifact import Artifact
from app.registry.description import KINDS, Judgement, Sensitivity
from app.scene.relations import ABOVE, CANONICAL, INSIDE, LATERAL, ON_TOP, SUPPORTS, opposite
from app.scene.roles import ON, UNDER, role_counts
from app.scene.scene import Scene, extent_of
from app.scene.stands import FLOOR, HANGS, SUPPORTED, UNKNOWN, Heights, floor_level, stands_of

BESIDE, SUPPORT, OVER, BELOW, STAND = range(len(KINDS))
"""Indices of the kinds in `KINDS`."""

THE_FLOOR: Final = "floor"
"""Name of the floor in an entry about an object that stands on the floor or hangs above it."""

_LEAST_P: Final = 1e-6  # minimum of p(stand)
EXPLAINED: Final = 5.0  # minimum z of an object above another object if a third object supports it
_NOWHERE: Final = (math.nan, math.nan, math.nan)

Indices = NDArray[np.int64]
Floats = NDArray[np.float64]


class Entries(NamedTuple):
    """The n judged entries of a scene of N objects.

    Attributes:
        triple: (n, 3) relation, subject and object. The object is -1 for the floor.
        kind: (n,) index of the kind in `KINDS`.
        terms: (n, 3) terms z, d and s; see the module.
        mover: (n,) object that would have moved if the entry is wrong.
    """

    triple: Indices
    kind: Indices
    terms: Floats
    mover: Indices


def entries_of(
    artifact: Artifact, posterior: Posterior, scene: Scene, flipped: Collection[Triple] = ()
) -> Entries:
    """Return the entries of a scene that the model can judge.

    Relations of structural classes are left out, because training does not learn them.

    Args:
        flipped: relations of the scene that the request states by their opposite.
    """
    row, is_structure = posterior.present.row, artifact.vocabulary.structure
    is_thing = ~is_structure[posterior.present.classes][row]
    stated = [
        (a, i, j)
        for a, i, j in scene.relations or ()
        if a < artifact.spec.A and is_thing[i] and is_thing[j]
    ]
    heights = None if scene.poses is None else _heights(artifact, scene)
    if heights is None:
        unders = {triple for triple in stated if _is_under(artifact, posterior, triple, flipped)}
    else:
        around = heights.around
        unders = {(a, i, j) for a, i, j in stated if a == ON_TOP and around[i, j]}
    supports = [(i, j) for a, i, j in stated if a in SUPPORTS and (a, i, j) not in unders]
    stands, log_p = _stands(artifact, posterior, scene, supports, heights)
    alone, change = posterior.alone_log_odds(), posterior.relation_change()
    rows: list[tuple[int, int, int]] = []
    kinds: list[int] = []
    terms: list[tuple[float, float, float]] = []
    movers: list[int] = []
    for a, i, j in stated:
        mover = j if (a, i, j) in flipped and a != INSIDE else i
        z, d, s = float(alone[a, row[i], row[j]]), float(change[a, row[i], row[j]]), 0.0
        if a in LATERAL:
            kind = BESIDE
        elif (a, i, j) in unders:
            kind, mover, s = BELOW, j, float(log_p[j]) if stands[j] == FLOOR else 0.0
            z = max(z, float(alone[ABOVE, row[i], row[j]]))
        elif a == ABOVE and stands[i] == FLOOR:
            kind, mover, s = BELOW, j, float(log_p[j]) if stands[j] == FLOOR else 0.0
            z = max(z, float(alone[ON_TOP, row[i], row[j]]))
        elif a == ABOVE:
            kind = OVER
            if stands[i] == HANGS:
                s = float(log_p[i])
            elif stands[i] == SUPPORTED or heights is not None:
                z = max(z, EXPLAINED)
        else:
            kind, mover, s = SUPPORT, i, float(log_p[i])
        rows.append((a, i, j))
        kinds.append(kind)
        terms.append((z, d, s))
        movers.append(mover)
    if heights is not None:
        for i in np.flatnonzero(is_thing & ((stands == FLOOR) | (stands == HANGS))).tolist():
            rows.append((ON_TOP if stands[i] == FLOOR else ABOVE, i, -1))
            kinds.append(STAND)
            terms.append((0.0, 0.0, float(log_p[i])))
            movers.append(i)
    return Entries(
        np.array(rows, np.int64).reshape(-1, 3),
        np.array(kinds, np.int64),
        np.array(terms, np.float64).reshape(-1, 3),
        np.array(movers, np.int64),
    )


def _is_under(
    artifact: Artifact, posterior: Posterior, triple: Triple, flipped: Collection[Triple]
) -> bool:
    """Return whether on-top(i, j) means that j is under i, and not that i stands on j."""
    a, i, j = triple
    if a != ON_TOP or triple in flipped:
        return a == ON_TOP
    if artifact.places is None:
        return False
    classes = posterior.present.classes[posterior.present.row]
    roles = artifact.places.roles
    under = role_counts(roles, int(classes[j]), int(classes[i]))[UNDER]
    return bool(under > role_counts(roles, int(classes[i]), int(classes[j]))[ON])


def _stands(
    artifact: Artifact,
    posterior: Posterior,
    scene: Scene,
    supports: Sequence[tuple[int, int]],
    heights: Heights | None,
) -> tuple[Indices, Floats]:
    """Return the stand of each of N objects, and its log p, (N,) each; 0 for an unknown stand.

    Args:
        supports: pairs of objects (i, j) with i on or in j.
        heights: heights of the boxes, or None for a scene without poses.
    """
    present, places = posterior.present, artifact.places
    stands, log_p = np.full(len(present.row), UNKNOWN), np.zeros(len(present.row))
    if places is None:
        return stands, log_p
    classes = present.classes[present.row]
    shares = places.stands[classes].astype(np.float64)
    if heights is not None and scene.poses is not None:
        floor = floor_level(heights.bottoms, shares[:, FLOOR])
        stands = stands_of(scene.poses.holds, scene.poses.observed, heights, floor)
    else:
        stands[[i for i, _ in supports]] = SUPPORTED
    is_unsupported = (stands == FLOOR) | (stands == HANGS)
    held = shares[is_unsupported, stands[is_unsupported]]
    log_p[is_unsupported] = np.log(np.maximum(held, _LEAST_P))
    is_supported = stands == SUPPORTED
    if is_supported.any():
        p = shares[:, SUPPORTED, None] * _support_shares(artifact, posterior)
        best = np.zeros(len(stands))
        for i, j in supports:
            best[i] = max(best[i], p[i, j])
        log_p[is_supported] = np.log(np.maximum(best[is_supported], _LEAST_P))
    log_p[artifact.vocabulary.structure[classes]] = 0.0
    return stands, log_p


def _heights(artifact: Artifact, scene: Scene) -> Heights:
    sizes = artifact.vocabulary.sizes
    centres = np.array([thing.position or _NOWHERE for thing in scene.objects])
    return Heights.of(centres, np.array([extent_of(thing, sizes) for thing in scene.objects]))


def _support_shares(artifact: Artifact, posterior: Posterior) -> Floats:
    """Return o_ij / (1 + sum_k o_ik) for all pairs of N objects, (N, N); see the module."""
    present, log_odds = posterior.present, posterior.alone_log_odds()
    table = artifact.relation_slopes.relation
    counts = present.log_counts[:, None] + present.log_counts
    odds = np.zeros(counts.shape)
    for a in SUPPORTS:
        if a < artifact.spec.A:
            intercept, slope, weight = table[a].tolist()
            odds += np.exp(intercept + slope * log_odds[a].astype(np.float64) + weight * counts)
    row = present.row
    by_object: Floats = odds[row[:, None], row]
    structure = artifact.vocabulary.structure[present.classes][row]
    by_object[:, structure] = 0.0
    np.fill_diagonal(by_object, 0.0)
    shares: Floats = by_object / (1.0 + by_object.sum(1, keepdims=True))
    return shares


def wrong_log_odds(judgement: Judgement, terms: Floats) -> Floats:
    """Return the log-odds that entries of one kind are wrong, (n,). `terms` is (n, 3)."""
    weights = np.array([judgement.relation, judgement.change, judgement.stand])
    log_odds: Floats = judgement.intercept + terms @ weights
    return log_odds


def wrong_relations(artifact: Artifact, scene: Scene) -> dict[Triple, float]:
    """Return the log-odds that each judged relation of a scene is wrong."""
    entries = entries_of(artifact, Posterior(artifact, scene), scene)
    log_odds: dict[Triple, float] = {}
    for _, rows, values in _judged(artifact, entries):
        triples = entries.triple[rows].tolist()
        log_odds |= {
            (a, i, j): z for (a, i, j), z in zip(triples, values.tolist(), strict=True) if j >= 0
        }
    return log_odds


def _judged(artifact: Artifact, entries: Entries) -> Iterator[tuple[Judgement, Indices, Floats]]:
    """Yield the judgement of each kind, its entries, and their log-odds to be wrong."""
    for kind, name in enumerate(KINDS):
        judgement: Judgement | None = getattr(artifact.calibration.misplaced, name)
        rows = np.flatnonzero(entries.kind == kind)
        if judgement is not None and len(rows):
            yield judgement, rows, wrong_log_odds(judgement, entries.terms[rows])


def misplaced_fields(
    artifact: Artifact,
    posterior: Posterior,
    scene: Scene,
    sensitivity: Sensitivity,
    flipped: Collection[Triple],
) -> list[Fields]:
    """Judge the observed relations, and the objects that nothing supports.

    The answer lists every observed relation of a kind that the model judges, without those of
    structure. An object on the floor, or hanging above it, is listed only if it reaches the most
    sensitive alarm line. The entry that is most probably wrong comes first. Entries with equal
    probabilities keep the order of `Scene.relations`.

    Returns:
        The fields of `scene_client.schemas.MisplacedRelation`.
    """
    entries = entries_of(artifact, posterior, scene, flipped)
    n = len(entries.kind)
    log_odds, is_misplaced, is_listed = np.full(n, -np.inf), np.zeros(n, bool), np.zeros(n, bool)
    for judgement, rows, values in _judged(artifact, entries):
        log_odds[rows] = values
        p = sigmoid(values)
        is_misplaced[rows] = p >= getattr(judgement.lines, sensitivity).threshold(len(rows))
        is_alarm = p >= judgement.lines.high.threshold(len(rows))
        is_listed[rows] = is_alarm | (entries.kind[rows] != STAND)
    is_listed |= is_misplaced
    order = np.argsort(-log_odds, kind="stable")
    order = order[is_listed[order]]
    return [
        _spelled(scene, entries.triple[k].tolist(), flipped)
        | {
            "probability": probability,
            "is_misplaced": bool(is_misplaced[k]),
            "moved": scene.objects[entries.mover[k]].id,
        }
        for k, probability in zip(
            order.tolist(), significant(sigmoid(log_odds[order])), strict=True
        )
    ]


def _spelled(scene: Scene, triple: list[int], flipped: Collection[Triple]) -> Fields:
    """Convert a canonical relation to the name, subject and object that the request uses."""
    relation, subject, object_ = triple
    name, things = CANONICAL[relation], scene.objects
    if object_ < 0:
        return {"subject": things[subject].id, "relation": name, "object": THE_FLOOR}
    if (relation, subject, object_) in flipped:
        subject, name, object_ = object_, opposite(name), subject
    return {"subject": things[subject].id, "relation": name, "object": things[object_].id}
