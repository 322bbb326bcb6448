"""Misplaced relations: which observed relations are wrong, and which object has moved?

An entry is an observed relation, or an object that nothing supports. There are four kinds:

    lateral   left or front
    support   an object on or in another object
    over      above, or on top of an object under it: a desk over a bin
    stand     an object that stands on the floor or hangs; it has no relation

The log-odds that an entry is wrong are a weighted sum of three terms (`app.registry.Judgement`):

    z   log-odds of the relation given the objects
    d   change of these log-odds by the other observed relations
    s   log p(stand) of the object that would have moved

The stand of an object is what holds it (`app.scene.stands`). With the shares S of the floor, of the
wall and of supports for the class of object i (`Places.stands`), and the odds o_ij that i is on or in
object j:

    p(floor) = S_floor    p(hangs) = S_wall    p(on or in j) = S_support · o_ij / (1 + sum_k o_ik)

The 1 stands for objects that the scene does not list. Positions and sizes show the stand of every
object. Without them, only a stated support shows the stand of its subject.
"""

from __future__ import annotations

from collections.abc import Collection
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from app.inference.elementary import sigmoid
from app.questions.answer import Fields, significant
from app.questions.posterior import Posterior
from app.questions.reading import Triple
from app.registry.artifact import Artifact
from app.registry.description import KINDS, Judgement, Sensitivity
from app.scene.relations import ABOVE, CANONICAL, INSIDE, LATERAL, ON_TOP, opposite
from app.scene.scene import Scene
from app.scene.stands import FLOOR, HANGS, SUPPORTED, UNKNOWN, floor_level, stands_of

LATERAL_KIND, SUPPORT, OVER, STAND = range(len(KINDS))
"""Indices of the kinds in `KINDS`."""

THE_FLOOR: Final = "floor"
"""Name of the floor in an entry about an object that stands on the floor or hangs above it."""

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
    stands, log_p = _stands(artifact, posterior, scene, flipped)
    row, is_structure = posterior.present.row, artifact.vocabulary.structure
    is_thing = ~is_structure[posterior.present.classes][row]
    stated = [
        (a, i, j)
        for a, i, j in scene.relations or ()
        if a < artifact.spec.A and is_thing[i] and is_thing[j]
    ]
    alone, change = posterior.alone_log_odds(), posterior.relation_change()
    rows: list[tuple[int, int, int]] = []
    kinds: list[int] = []
    terms: list[tuple[float, float, float]] = []
    movers: list[int] = []
    for a, i, j in stated:
        kind, mover = _kind(a, i, j, stands, log_p, (a, i, j) in flipped)
        z, d = alone[a, row[i], row[j]], change[a, row[i], row[j]]
        rows.append((a, i, j))
        kinds.append(kind)
        terms.append((float(z), float(d), 0.0 if kind == LATERAL_KIND else float(log_p[mover])))
        movers.append(mover)
    if scene.poses is not None:
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


def _kind(
    a: int, i: int, j: int, stands: Indices, log_p: Floats, is_flipped: bool
) -> tuple[int, int]:
    """Return the kind of a relation a(i, j), and the object that would have moved.

    Of two objects over each other, the object with the less likely stand would have moved. Without
    positions, it is the subject in the words of the request.
    """
    if a in LATERAL:
        return LATERAL_KIND, j if is_flipped else i
    if a == INSIDE or (a == ON_TOP and stands[i] == SUPPORTED):
        return SUPPORT, i
    if log_p[i] != log_p[j]:
        return OVER, i if log_p[i] < log_p[j] else j
    return OVER, j if is_flipped else i


def _stands(
    artifact: Artifact, posterior: Posterior, scene: Scene, flipped: Collection[Triple]
) -> tuple[Indices, Floats]:
    """Return what holds each of N objects, and log p of it, (N,) each; 0 for an unknown stand."""
    present, places = posterior.present, artifact.places
    stands, log_p = np.full(len(present.row), UNKNOWN), np.zeros(len(present.row))
    if places is None:
        return stands, log_p
    classes = present.classes[present.row]
    shares = places.stands[classes].astype(np.float64)
    supports = [
        (i, j)
        for a, i, j in scene.relations or ()
        if a == INSIDE or (a == ON_TOP and (a, i, j) not in flipped)
    ]
    if scene.poses is not None:
        bottoms = np.array([_bottom(artifact, thing) for thing in scene.objects])
        floor = floor_level(bottoms, shares[:, FLOOR])
        stands = stands_of(scene.poses.holds, scene.poses.observed, bottoms, floor)
    else:
        stands[[i for i, _ in supports]] = SUPPORTED
    is_unsupported = (stands == FLOOR) | (stands == HANGS)
    log_p[is_unsupported] = np.log(shares[is_unsupported, stands[is_unsupported]])
    is_supported = stands == SUPPORTED
    if is_supported.any():
        p = shares[:, SUPPORTED, None] * _support_shares(artifact, posterior)
        best = np.zeros(len(stands))
        for i, j in supports:
            best[i] = max(best[i], p[i, j])
        log_p[is_supported] = np.log(np.maximum(best[is_supported], 1e-12))
    log_p[artifact.vocabulary.structure[classes]] = 0.0
    return stands, log_p


def _bottom(artifact: Artifact, thing: Any) -> float:
    """Return the height of the bottom of an object in metres, or NaN if it is unknown."""
    if thing.position is None:
        return float("nan")
    size = artifact.vocabulary.extent(thing)
    return float(thing.position[2] - size[2] / 2)


def _support_shares(artifact: Artifact, posterior: Posterior) -> Floats:
    """Return o_ij / (1 + sum_k o_ik) for all pairs of N objects, (N, N); see the module."""
    present, log_odds = posterior.present, posterior.alone_log_odds()
    table = artifact.relation_slopes.relation
    counts = present.log_counts[:, None] + present.log_counts
    odds = np.zeros(counts.shape)
    for a in (ON_TOP, INSIDE):
        if a < artifact.spec.A:
            intercept, slope, weight = table[a].tolist()
            odds += np.exp(intercept + slope * log_odds[a].astype(np.float64) + weight * counts)
    row = present.row
    by_object: Floats = odds[row[:, None], row]
    structure = artifact.vocabulary.structure[present.classes][row]
    by_object[:, structure] = 0.0
    np.fill_diagonal(by_object, 0.0)
    return by_object / (1.0 + by_object.sum(1, keepdims=True))


def wrong_log_odds(judgement: Judgement, terms: Floats) -> Floats:
    """Return the log-odds that entries of one kind are wrong, (n,). `terms` is (n, 3)."""
    weights = np.array([judgement.relation, judgement.change, judgement.stand])
    log_odds: Floats = judgement.intercept + terms @ weights
    return log_odds


def misplaced_fields(
    artifact: Artifact,
    posterior: Posterior,
    scene: Scene,
    sensitivity: Sensitivity,
    flipped: Collection[Triple],
) -> list[Fields]:
    """Judge the observed relations, and the objects that nothing supports.

    The answer lists every observed relation of known classes. An object on the floor, or hanging
    above it, is listed only if it is misplaced. The entry that is most probably wrong comes first.
    Entries with equal probabilities keep the order of `Scene.relations`.

    Returns:
        The fields of `scene_client.schemas.MisplacedRelation`.
    """
    entries = entries_of(artifact, posterior, scene, flipped)
    log_odds = np.full(len(entries.kind), -np.inf)
    is_misplaced = np.zeros(len(entries.kind), np.bool_)
    is_judged = np.zeros(len(entries.kind), np.bool_)
    for kind, name in enumerate(KINDS):
        judgement: Judgement | None = getattr(artifact.calibration.misplaced, name)
        rows = np.flatnonzero(entries.kind == kind)
        if judgement is None or not len(rows):
            continue
        log_odds[rows] = wrong_log_odds(judgement, entries.terms[rows])
        line = getattr(judgement.lines, sensitivity)
        is_misplaced[rows] = sigmoid(log_odds[rows]) >= line.threshold(len(rows))
        is_judged[rows] = True
    listed = is_judged & (is_misplaced | (entries.kind != STAND))
    order = np.argsort(-log_odds, kind="stable")
    order = order[listed[order]]
    numbers = significant(sigmoid(log_odds[order]))
    return [
        _spelled(scene, entries.triple[k].tolist(), flipped)
        | {
            "probability": probability,
            "is_misplaced": bool(is_misplaced[k]),
            "moved": scene.objects[entries.mover[k]].id if is_misplaced[k] else None,
        }
        for k, probability in zip(order.tolist(), numbers, strict=True)
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
