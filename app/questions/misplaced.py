"""Misplaced relations: which observed relations are wrong, and which object has moved?

An entry is an observed relation, or an object that nothing supports. There are five kinds:

    lateral   left or front
    support   an object on or in another object
    above     an object above another object
    under     an object under another object: a bin under a desk
    stand     an object that stands on the floor or hangs; it has no relation

"Under" is the opposite of on-top, so both have one unit: "the desk is on top of the bin". The words
of the request tell them apart, or the boxes. People also say "under" for "below", so z of such an
entry is the larger of the two. It is at least `Places.under_evidence`. An object may be above
another object if a third object supports it.

The log-odds that an entry is wrong are a weighted sum of four terms (`app.registry.Judgement`):

    z   log-odds of the relation given the objects, at least `LEAST_Z`
    d   change of these log-odds by the other observed relations
    s   log p(stand) of the object that would have moved
    q   log of the share of its supporter among the supporters of its class (`Places.supporters`)

The stand of an object is what holds it (`app.scene.stands`). `Places.stands` has the shares S of
the floor, of the wall and of supports for its class. An object that is neither on the floor nor on
or in a listed object hangs on a wall, or an unlisted object holds it:

    p(floor) = S_floor    p(supported) = S_support    p(neither) = S_wall + S_support · (1 - sum q)

The sum of the shares q is over the listed classes. Positions and sizes show the stand of every
object; otherwise s = 0. Classes that belong everywhere, such as pets and bags, have s = q = 0, and
only their supports are judged.
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
from app.scene.scene import Scene, extent_of
from app.scene.stands import (
    FLOOR,
    HANGS,
    SUPPORTED,
    UNKNOWN,
    USUAL,
    Heights,
    floor_level,
    stands_of,
)

BESIDE, SUPPORT, OVER, BELOW, STAND = range(len(KINDS))
"""Indices of the kinds in `KINDS`."""

TERMS: Final = 4
"""Number of terms of an entry."""

THE_FLOOR: Final = "floor"
"""Name of the floor in an entry about an object that stands on the floor or hangs above it."""

LEAST_Z: Final = -8.0  # below it, log-odds do not tell wrong relations from rare ones
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
        terms: (n, 4) terms z, d, s and q; see the module.
        mover: (n,) object that would have moved if the entry is wrong.
    """

    triple: Indices
    kind: Indices
    terms: Floats
    mover: Indices


_NO_ENTRIES: Final = Entries(
    np.zeros((0, 3), np.int64), np.zeros(0, np.int64), np.zeros((0, TERMS)), np.zeros(0, np.int64)
)


def entries_of(
    artifact: Artifact, posterior: Posterior, scene: Scene, flipped: Collection[Triple] = ()
) -> Entries:
    """Return the entries of a scene that the model can judge.

    Relations of structural classes are left out, because training does not learn them.

    Args:
        flipped: relations of the scene that the request states by their opposite.
    """
    row = posterior.present.row
    classes = posterior.present.classes[row]
    is_thing = ~artifact.vocabulary.structure[classes]
    stated = [
        (a, i, j)
        for a, i, j in scene.relations or ()
        if a < artifact.spec.A and is_thing[i] and is_thing[j]
    ]
    if not stated and scene.poses is None:
        return _NO_ENTRIES
    heights = None if scene.poses is None else _heights(artifact, scene, classes)
    if heights is None:
        unders = {triple for triple in stated if triple[0] == ON_TOP and triple in flipped}
    else:
        around = heights.around
        unders = {(a, i, j) for a, i, j in stated if a == ON_TOP and around[i, j]}
    supports = [(i, j) for a, i, j in stated if a in SUPPORTS and (a, i, j) not in unders]
    stands, log_p, log_q = _stands(artifact, posterior, scene, supports, heights)
    alone, change = posterior.alone_log_odds(), posterior.relation_change()
    rows: list[tuple[int, int, int]] = []
    kinds: list[int] = []
    terms: list[tuple[float, float, float, float]] = []
    movers: list[int] = []
    moves = ~artifact.vocabulary.anywhere[classes]
    for a, i, j in stated:
        mover = j if (a, i, j) in flipped and a != INSIDE else i
        z, d = float(alone[a, row[i], row[j]]), float(change[a, row[i], row[j]])
        s = q = 0.0
        if a in LATERAL:
            kind = BESIDE
        elif (a, i, j) in unders or (a == ABOVE and stands[i] == FLOOR):
            kind, mover = BELOW, j
        elif a == ABOVE:
            kind = OVER
            if stands[i] == HANGS:
                s = float(log_p[i])
            elif stands[i] == SUPPORTED or heights is not None:
                z = max(z, EXPLAINED)
        else:
            kind, mover, s, q = SUPPORT, i, float(log_p[i]), float(log_q[i])
        if kind == BELOW:
            s = float(log_p[j]) if stands[j] == FLOOR else 0.0
            z = max(float(alone[b, row[i], row[j]]) for b in (ON_TOP, ABOVE))
            if artifact.places is not None:
                z = max(z, artifact.places.under_evidence(int(classes[i]), int(classes[j])))
        if not moves[mover]:
            if kind == BELOW:
                continue
            s = q = 0.0
        rows.append((a, i, j))
        kinds.append(kind)
        terms.append((max(z, LEAST_Z), d, s, q))
        movers.append(mover)
    if heights is not None:
        is_free = (stands == FLOOR) | (stands == HANGS)
        for i in np.flatnonzero(is_thing & moves & is_free).tolist():
            rows.append((ON_TOP if stands[i] == FLOOR else ABOVE, i, -1))
            kinds.append(STAND)
            terms.append((0.0, 0.0, float(log_p[i]), 0.0))
            movers.append(i)
    return Entries(
        np.array(rows, np.int64).reshape(-1, 3),
        np.array(kinds, np.int64),
        np.array(terms, np.float64).reshape(-1, TERMS),
        np.array(movers, np.int64),
    )


def _stands(
    artifact: Artifact,
    posterior: Posterior,
    scene: Scene,
    supports: Sequence[tuple[int, int]],
    heights: Heights | None,
) -> tuple[Indices, Floats, Floats]:
    """Return the stand of each of N objects, its log p, and log q of its supporter, (N,) each.

    The values are 0 for an unknown stand, and log p without poses.

    Args:
        supports: pairs of objects (i, j) with i on or in j.
        heights: heights of the boxes, or None for a scene without poses.
    """
    present, places = posterior.present, artifact.places
    stands, zeros = np.full(len(present.row), UNKNOWN), np.zeros(len(present.row))
    if places is None:
        return stands, zeros, zeros
    classes = present.classes[present.row]
    shares = places.stands[classes].astype(np.float64)
    if heights is not None and scene.poses is not None:
        floor = floor_level(heights.bottoms, shares[:, FLOOR])
        stands = stands_of(scene.poses.holds, scene.poses.observed, heights, floor)
    else:
        stands[[i for i, _ in supports]] = SUPPORTED
    if (stands == UNKNOWN).all():
        return stands, zeros, zeros
    by_class = places.supporters(classes, present.classes)
    by_class[:, artifact.vocabulary.structure[present.classes]] = 0.0
    q = np.where(stands == SUPPORTED, 0.0, 1.0)
    for i, j in supports:
        if stands[i] == SUPPORTED:
            q[i] = max(q[i], by_class[i, present.row[j]])
    log_q = np.log(np.maximum(q, _LEAST_P))
    if heights is None:
        return stands, zeros, log_q
    shares[:, HANGS] += shares[:, SUPPORTED] * (1 - by_class.sum(1))
    p = np.where(stands == UNKNOWN, 1.0, shares[np.arange(len(stands)), stands])
    return stands, np.log(np.maximum(p, _LEAST_P)), log_q


def _heights(artifact: Artifact, scene: Scene, classes: Indices) -> Heights:
    """Return the heights of the objects. Furniture whose box is only its top reaches down."""
    sizes, places = artifact.vocabulary.sizes, artifact.places
    centres = np.array([thing.position or _NOWHERE for thing in scene.objects])
    extents = np.array([extent_of(thing, sizes) for thing in scene.objects])
    heights = Heights.of(centres, extents)
    if places is None:
        return heights
    usual = sizes[classes, 2]
    is_top = (places.stands[classes, FLOOR] >= USUAL) & (extents[:, 2] < usual / 2)
    lower = np.where(is_top, np.fmin(heights.bottoms, heights.tops - usual), heights.bottoms)
    return heights._replace(bottoms=lower)


def wrong_log_odds(judgement: Judgement, terms: Floats) -> Floats:
    """Return the log-odds that entries of one kind are wrong, (n,). `terms` is (n, 4)."""
    weights = np.array([judgement.relation, judgement.change, judgement.stand, judgement.supporter])
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
    probabilities keep the order of `Scene.relations`. An object under another object is the subject
    of its entry.

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
    unders = entries.triple[entries.kind == BELOW].tolist()
    spelled = {*flipped, *((a, i, j) for a, i, j in unders)}
    return [
        _spelled(scene, entries.triple[k].tolist(), spelled)
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
    """Convert a canonical relation to a name, subject and object; the opposite if it is flipped."""
    relation, subject, object_ = triple
    name, things = CANONICAL[relation], scene.objects
    if object_ < 0:
        return {"subject": things[subject].id, "relation": name, "object": THE_FLOOR}
    if (relation, subject, object_) in flipped:
        subject, name, object_ = object_, opposite(name), subject
    return {"subject": things[subject].id, "relation": name, "object": things[object_].id}
