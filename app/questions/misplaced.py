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

The log-odds that an entry is wrong are a weighted sum of four terms (`app.model.Judgement`):

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

A relation that a person has confirmed (`app.model.Misplaced.confirmed`) has z = `EXPLAINED` and
d = s = q = 0, because its stand may be rare for the class.
"""

from collections.abc import Iterator, Sequence
from itertools import chain
from typing import Final, NamedTuple

import numpy as np
from jaxtyping import Float, Int
from numpy.typing import NDArray

from app.inference.elementary import sigmoid
from app.model.calibration import KINDS, Judgement, Sensitivity
from app.model.scene_model import SceneModel
from app.questions.answer import Fields, significant
from app.questions.posterior import Posterior
from app.scene.relation_table import Triple
from app.scene.scene import Scene, boxes_of
from app.scene.spatial_relations import (
    ABOVE,
    CANONICAL,
    INSIDE,
    LATERAL,
    ON_TOP,
    SUPPORTS,
    opposite,
)
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

BESIDE, SUPPORT, OVER, BELOW, STAND = range(len(KINDS))  # indices of the kinds in `KINDS`
TERMS: Final = 4  # number of terms of an entry

THE_FLOOR: Final = "floor"
"""Name of the floor in an entry about an object that stands on the floor or hangs above it."""

LEAST_Z: Final = -8.0  # below it, log-odds do not tell wrong relations from rare ones
_LEAST_P: Final = 1e-6  # minimum of p(stand)
EXPLAINED: Final = 5.0
"""z of a confirmed relation; minimum z of an object above another object on a third object."""

Indices = NDArray[np.int64]
Floats = NDArray[np.float64]


class Entries(NamedTuple):
    """The n judged entries of a scene of N objects."""

    triple: Int[Indices, "n 3"]  # relation, subject and object, which is -1 for the floor
    kind: Int[Indices, "n"]  # index in `KINDS`
    terms: Float[Floats, "n 4"]  # z, d, s and q; see the module
    mover: Int[Indices, "n"]  # object that would have moved if the entry is wrong


_NO_ENTRIES: Final = Entries(
    np.zeros((0, 3), np.int64), np.zeros(0, np.int64), np.zeros((0, TERMS)), np.zeros(0, np.int64)
)


def entries_of(model: SceneModel, posterior: Posterior, scene: Scene) -> Entries:
    """Return the entries that the model can judge. Training learns no relations of structure."""
    row, A, places = posterior.present.row, model.spec.A, model.places
    classes = model.vocabulary.stand_in[posterior.present.classes][row]
    is_thing = (~model.vocabulary.structure[classes]).tolist()
    stated = [t for t in scene.triples if t[0] < A and is_thing[t[1]] and is_thing[t[2]]]
    if not stated and not scene.has_boxes:
        return _NO_ENTRIES
    heights, around, opposites = None, None, scene.opposites
    if scene.has_boxes:
        heights = _heights(model, scene, classes)
        around = heights.around
    unders = {
        (a, i, j)
        for a, i, j in stated
        if a == ON_TOP and ((a, i, j) in opposites if around is None else around[i, j])
    }
    supports = [(i, j) for a, i, j in stated if a in SUPPORTS and (a, i, j) not in unders]
    stands, log_p, log_q = (
        values.tolist() for values in _stands(model, posterior, scene, supports, heights)
    )
    moves = (~model.vocabulary.anywhere[classes]).tolist()
    relation, subject, object_ = np.fromiter(chain(*stated), np.int64).reshape(-1, 3).T
    alone, pairs = posterior.alone_log_odds(), (row[subject], row[object_])
    of_relation, changes = (
        values[relation, *pairs].tolist() for values in (alone, posterior.relation_change())
    )
    confirmed = {*model.calibration.misplaced.confirmed}
    # An entry has relation a, subject i, object j, kind, the terms z, d, s and q, and the mover.
    entries: list[tuple[float, ...]] = []
    for (a, i, j), z, d in zip(stated, of_relation, changes, strict=True):
        mover = j if (a, i, j) in opposites and a != INSIDE else i
        s = q = 0.0
        if a in LATERAL:
            kind = BESIDE
        elif (a, i, j) in unders or (a == ABOVE and stands[i] == FLOOR):
            if not moves[j]:
                continue
            kind, mover = BELOW, j
            s = log_p[j] if stands[j] == FLOOR else 0.0
            z = float(alone[ON_TOP : ABOVE + 1, row[i], row[j]].max())
            if places is not None:
                z = max(z, places.under_evidence(int(classes[i]), int(classes[j])))
        elif a == ABOVE:
            kind = OVER
            if stands[i] == HANGS:
                s = log_p[i]
            elif stands[i] == SUPPORTED or heights is not None:
                z = max(z, EXPLAINED)
        else:
            kind, mover, s, q = SUPPORT, i, log_p[i], log_q[i]
        if not moves[mover]:
            s = q = 0.0
        if (a, classes[i], classes[j]) in confirmed:
            z, d, s, q = EXPLAINED, 0.0, 0.0, 0.0
        entries.append((a, i, j, kind, max(z, LEAST_Z), d, s, q, mover))
    for i, stand in enumerate(stands if heights is not None else ()):
        if is_thing[i] and moves[i] and stand in (FLOOR, HANGS):
            relation_to_floor = ON_TOP if stand == FLOOR else ABOVE
            entries.append((relation_to_floor, i, -1, STAND, 0.0, 0.0, log_p[i], 0.0, i))
    table = np.fromiter(chain(*entries), np.float64).reshape(-1, 5 + TERMS)
    numbers = table.astype(np.int64)
    return Entries(numbers[:, :3], numbers[:, 3], table[:, 4 : 4 + TERMS], numbers[:, -1])


def _stands(
    model: SceneModel,
    posterior: Posterior,
    scene: Scene,
    supports: Sequence[tuple[int, int]],
    heights: Heights | None,
) -> tuple[Int[Indices, "N"], Float[Floats, "N"], Float[Floats, "N"]]:
    """Return the stand of each object, its log p, and log q of its supporter.

    The values are 0 for an unknown stand, and log p without poses. `supports` has pairs (i, j) of
    objects with i on or in j. `heights` is None without poses.
    """
    present, places = posterior.present, model.places
    stands, zeros = np.full(len(present.row), UNKNOWN), np.zeros(len(present.row))
    if places is None:
        return stands, zeros, zeros
    listed = model.vocabulary.stand_in[present.classes]
    classes = listed[present.row]
    stand_shares = places.stands[classes].astype(np.float64)
    if heights is not None and scene.relations is not None:
        floor = floor_level(heights.bottoms, stand_shares[:, FLOOR].copy())
        stands = stands_of(*scene.relations.grids(len(classes)), heights, floor)
    else:
        stands[[i for i, _ in supports]] = SUPPORTED
    if (stands == UNKNOWN).all():
        return stands, zeros, zeros
    by_class = places.supporters(classes, listed)
    by_class[:, model.vocabulary.structure[present.classes]] = 0.0
    is_supported = stands == SUPPORTED
    q = np.where(is_supported, 0.0, 1.0)
    for i, j in supports:
        if is_supported[i]:
            q[i] = max(q[i], by_class[i, present.row[j]])
    log_q = np.log(np.maximum(q, _LEAST_P))
    if heights is None:
        return stands, zeros, log_q
    stand_shares[:, HANGS] += stand_shares[:, SUPPORTED] * (1 - by_class.sum(1))
    p = np.where(stands == UNKNOWN, 1.0, stand_shares[np.arange(len(stands)), stands])
    return stands, np.log(np.maximum(p, _LEAST_P)), log_q


def _heights(model: SceneModel, scene: Scene, classes: Indices) -> Heights:
    """Return the heights of the objects. Furniture whose box is only its top reaches down."""
    centres, extents = boxes_of(scene.objects, model.vocabulary.sizes)
    heights, places = Heights.of(centres, extents), model.places
    if places is None:
        return heights
    heights_of_class, tops = model.vocabulary.sizes[classes, 2], heights.tops
    is_top = (places.stands[classes, FLOOR] >= USUAL) & (extents[:, 2] < heights_of_class / 2)
    bottoms = np.where(is_top, np.fmin(heights.bottoms, tops - heights_of_class), heights.bottoms)
    return Heights(bottoms, tops, heights.areas)


def wrong_log_odds(judgement: Judgement, terms: Float[Floats, "n 4"]) -> Float[Floats, "n"]:
    """Return the log-odds that entries of one kind are wrong."""
    weights = np.array([judgement.relation, judgement.change, judgement.stand, judgement.supporter])
    return judgement.intercept + terms @ weights


def wrong_relations(model: SceneModel, scene: Scene) -> dict[Triple, float]:
    """Return the log-odds that each judged relation of a scene is wrong."""
    entries = entries_of(model, Posterior(model, scene), scene)
    return {
        (a, i, j): log_odds
        for _, rows, values in _judged(model, entries)
        for (a, i, j), log_odds in zip(entries.triple[rows].tolist(), values.tolist(), strict=True)
        if j >= 0  # other entries are about the floor
    }


def _judged(model: SceneModel, entries: Entries) -> Iterator[tuple[Judgement, Indices, Floats]]:
    """Yield the judgement of each kind, its entries, and their log-odds to be wrong."""
    for kind in sorted({*entries.kind.tolist()}):
        judgement: Judgement | None = getattr(model.calibration.misplaced, KINDS[kind])
        if judgement is not None:
            rows = (entries.kind == kind).nonzero()[0]
            yield judgement, rows, wrong_log_odds(judgement, entries.terms[rows])


def misplaced_fields(
    model: SceneModel, posterior: Posterior, scene: Scene, sensitivity: Sensitivity
) -> list[Fields]:
    """Judge the observed relations, and the objects that nothing supports.

    Every relation of a kind that the model judges is listed, without structure. An object on the
    floor, or hanging above it, is listed only if it reaches the most sensitive alarm line. The most
    probably wrong entry comes first. Equal probabilities keep the order of `Scene.triples`. An
    object under another object is the subject of its entry.
    `scene_client.schemas.MisplacedRelation` defines the fields.
    """
    entries = entries_of(model, posterior, scene)
    n = len(entries.kind)
    if not n:
        return []
    log_odds, line, lowest = np.full(n, -np.inf), np.full(n, np.inf), np.full(n, np.inf)
    for judgement, rows, values in _judged(model, entries):
        log_odds[rows] = values
        line[rows] = getattr(judgement.lines, sensitivity).threshold(len(rows))
        lowest[rows] = judgement.lines.high.threshold(len(rows))
    p, is_relation = sigmoid(log_odds), (entries.kind != STAND) & (log_odds > -np.inf)
    order = np.argsort(-log_odds, kind="stable")
    order = order[(is_relation | (p >= np.minimum(line, lowest)))[order]]
    ids = [thing.id for thing in scene.objects]
    columns = (
        *(entries.triple[order].tolist(), entries.kind[order].tolist()),
        *(significant(p[order]), (p >= line)[order].tolist(), entries.mover[order].tolist()),
    )
    fields: list[Fields] = []
    for (relation, subject, object_), kind, probability, is_misplaced, mover in zip(
        *columns, strict=True
    ):
        name = CANONICAL[relation]
        if kind == BELOW or (relation, subject, object_) in scene.opposites:
            subject, name, object_ = object_, opposite(name), subject
        fields.append(
            {
                "subject": ids[subject],
                "relation": name,
                "object": ids[object_] if kind != STAND else THE_FLOOR,
                "probability": probability,
                "is_misplaced": is_misplaced,
                "moved": ids[mover],
            }
        )
    return fields
