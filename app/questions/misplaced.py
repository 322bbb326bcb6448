"""Misplaced objects: which stated relations are wrong, and which boxes are at a wrong place?

Without boxes, an entry is a relation that the request states. There are four kinds:

    lateral   left or front
    support   an object on or in another object
    above     an object above another object
    under     an object under another object: a bin under a desk

"Under" is the opposite of on-top, so both have one unit: "the desk is on top of the bin". The words
of the request tell them apart. People also say "under" for "below", so z of such an entry is the
larger of the two. It is at least `Places.under_evidence`. An object may be above another object if
a third object supports it.

With boxes, an entry is an object. The likeliest wrong place of its box (`app.questions.standing`)
gives one of three kinds: on_floor, on_object, and unheld if it floats or is sunk in.

The log-odds that an entry is wrong are a weighted sum of six terms (`app.model.Judgement`):

    z   log-odds of the relation given the objects, at least `LEAST_Z`, times k
    d   change of these log-odds by the other observed relations
    s   log share of objects of the class on or in objects; with boxes, -t of `Standing`
    q   log of the share of the supporter among the supporters of the class (`Places.supporters`)
    u   1 - k, times the sum of these log-odds and of the part of the prior that they lack
        (`app.model.possibility`)
    l   log of the number of entries, because hardly more than one entry of a scene is wrong

k = n / (n + 2) is the share of the log-odds that n training scenes with the relation show. z, d, q
and u of boxes are r times those of the support (`app.questions.standing`), and 0 for other kinds
with boxes. Classes that belong everywhere, such as pets and bags, have s = q = 0, and only their
supports are judged.

A relation that a person has confirmed (`app.model.Misplaced.confirmed`) has z = `EXPLAINED` and
d = s = q = u = 0, because its place may be rare for the class.
"""

from collections.abc import Iterator
from itertools import chain
from typing import Final, NamedTuple

import numpy as np
from jaxtyping import Float, Int
from numpy.typing import NDArray

from app.inference.elementary import sigmoid
from app.model.calibration import KINDS, WEIGHTS, Judgement, Sensitivity
from app.model.possibility import IN, ON, OVER, PRIOR_SHARE, UNDER, known_share
from app.model.scene_model import SceneModel
from app.model.statistics import Places
from app.questions.answer import Fields, significant
from app.questions.doubt import LEAST_REAL
from app.questions.posterior import Posterior
from app.questions.standing import (
    FLOATS,
    ON_FLOOR,
    ON_OBJECT,
    SUNK,
    Standing,
    shares_in_scene,
    standing,
)
from app.scene.relation_table import Triple
from app.scene.scene import Scene, boxes_of, errors_of
from app.scene.spatial_relations import (
    ABOVE,
    CANONICAL,
    INSIDE,
    LATERAL,
    ON_TOP,
    STACKED,
    SUPPORTS,
    opposite,
)
from app.scene.stands import FLOOR, SUPPORTED, USUAL, floor_level

BESIDE, SUPPORT, OVER_IT, BELOW, POSED, HELD, UNHELD = range(len(KINDS))
"""Indices of kinds in `KINDS`. From `POSED` on, entries are about boxes."""

_REASONS: Final = {
    ON_FLOOR: (ON_TOP, POSED, "on-floor"), ON_OBJECT: (ON_TOP, HELD, "wrong-support"),
    FLOATS: (ABOVE, UNHELD, "floats"), SUNK: (INSIDE, UNHELD, "sunk-in"),
}  # fmt: skip
"""Relation, kind and name of the reasons of `Standing`. On top of an object may also be inside."""

_REASON_OF: Final = {
    **{(relation, kind): name for relation, kind, name in _REASONS.values()},
    (INSIDE, HELD): "wrong-support",
}

TERMS: Final = 6  # number of terms of an entry

THE_FLOOR: Final = "floor"
"""Name of the floor in an entry about an object that stands on the floor or floats above it."""

LEAST_Z: Final = -8.0  # below it, log-odds do not tell wrong relations from rare ones
_LEAST_P: Final = 3e-4  # minimum of a share
LEAST_LISTED: Final = 0.05  # least probability of a listed box that is not on an object
_PARTIAL: Final = 0.8  # share of the usual height below which the lower part may be hidden
_LIKE: Final = 0.3  # maximum difference of the height of a top, as a share of the usual height
EXPLAINED: Final = 5.0
"""z of a confirmed relation; minimum z of an object above another object on a third object."""

Indices = NDArray[np.int64]
Floats = NDArray[np.float64]


class Entries(NamedTuple):
    """The n judged entries of a scene of N objects."""

    triple: Int[Indices, "n 3"]  # relation, subject and object, which is -1 for the floor
    kind: Int[Indices, "n"]  # index in `KINDS`
    terms: Float[Floats, "n 6"]  # z, d, s, q, u and l; see the module
    mover: Int[Indices, "n"]  # object that would have moved if the entry is wrong


_NO_ENTRIES: Final = Entries(
    np.zeros((0, 3), np.int64), np.zeros(0, np.int64), np.zeros((0, TERMS)), np.zeros(0, np.int64)
)

# An entry has relation a, subject i, object j, kind, the terms z, d, s, q and u, and the mover.
_Entry = tuple[float, ...]


def entries_of(model: SceneModel, posterior: Posterior, scene: Scene) -> Entries:
    """Return the entries that the model can judge. Training learns no relations of structure."""
    entries = list((_posed if scene.has_boxes else _stated)(model, posterior, scene))
    if not entries:
        return _NO_ENTRIES
    table = np.fromiter(chain(*entries), np.float64).reshape(len(entries), -1)
    numbers, log_n = table.astype(np.int64), np.full((len(table), 1), np.log(len(table)))
    terms = np.concatenate([table[:, 4:-1], log_n], axis=1)
    return Entries(numbers[:, :3], numbers[:, 3], terms, numbers[:, -1])


class _Evidence:
    """The terms of the relations between the objects of a scene."""

    def __init__(self, model: SceneModel, posterior: Posterior) -> None:
        present, vocabulary, places = posterior.present, model.vocabulary, model.places
        self.row, self.places = present.row, places
        listed = vocabulary.stand_in[present.classes]
        self.classes = listed[self.row]
        self.is_thing = ~vocabulary.structure[self.classes]
        self.moves = ~vocabulary.anywhere[self.classes]
        N, n = len(self.row), len(listed)
        self.stands, self.supporters = np.ones((N, 3)), np.ones((N, n))
        self.any_supporters = np.zeros((1, n))
        if places is not None:
            self.stands = places.stands[self.classes].astype(np.float64)
            self.supporters = places.supporters(self.classes, listed)
            self.any_supporters = places.any_supporters(listed)[None].copy()
            is_structure = vocabulary.structure[present.classes]
            self.supporters[:, is_structure] = self.any_supporters[:, is_structure] = 0.0
        self._z, self._d = posterior.alone_log_odds(), posterior.relation_change()
        self._confirmed = {*model.calibration.misplaced.confirmed}
        self.prior, self.scenes = np.zeros((4, n, n)), np.full((len(STACKED), n, n), np.inf)
        if model.possibility is not None and places is not None:
            rows = model.descriptions[listed]
            self.prior = model.possibility.log_p(rows, rows)
            self.scenes = places.scenes(STACKED, listed, listed)

    def z(self, a: int, i: int, j: int) -> float:
        """Return the log-odds of a relation of two objects."""
        return float(self._z[a, self.row[i], self.row[j]])

    def d(self, a: int, i: int, j: int) -> float:
        """Return the change of the log-odds of a relation by other relations."""
        return float(self._d[a, self.row[i], self.row[j]])

    def q(self, i: int, j: int) -> float:
        """Return the log of the share of object j among the supporters of object i."""
        return float(np.log(max(self.supporters[i, self.row[j]], _LEAST_P)))

    def support(self, a: int, i: int, j: int) -> tuple[float, float]:
        """Return the terms z and u of object i on or in object j."""
        z, share = self.z(a, i, j), 1.0
        if a == ON_TOP and self.places is not None:
            share = self.places.literal_share(int(self.classes[i]), int(self.classes[j]))
        place = ON if a == ON_TOP else IN
        return self.known_and_unknown((a, i, j), place, z + float(np.log(share)), i, j, share)

    def known_and_unknown(
        self, triple: Triple, place: int, z: float, thing: int, other: int, share: float = 1.0
    ) -> tuple[float, float]:
        """Return the terms z and u of a stacked relation with a place of a thing at another.

        Only the share of the training scenes counts.
        """
        a, i, j = triple
        k = known_share(share * self.scenes[a - ON_TOP, self.row[i], self.row[j]])
        z, c = max(z, LEAST_Z), self.prior[place, self.row[thing], self.row[other]]
        return float(k * z), float((1.0 - k) * (z + (1.0 - PRIOR_SHARE) * c))

    def is_confirmed(self, a: int, i: int, j: int) -> bool:
        """Return whether a person has confirmed a relation of these classes."""
        return (a, int(self.classes[i]), int(self.classes[j])) in self._confirmed


def _stated(model: SceneModel, posterior: Posterior, scene: Scene) -> Iterator[_Entry]:
    """Yield the entries about the relations that a request states."""
    A, places, opposites = model.spec.A, model.places, scene.opposites
    stated = [triple for triple in scene.triples if triple[0] < A]
    if not stated:
        return
    evidence = _Evidence(model, posterior)
    supported = {i for a, i, j in stated if a in SUPPORTS and (a, i, j) not in opposites}
    for a, i, j in stated:
        # Training shows no stacks of things of one class.
        is_pair = a in LATERAL or evidence.classes[i] != evidence.classes[j]
        if not (is_pair and evidence.is_thing[i] and evidence.is_thing[j]):
            continue
        is_opposite = (a, i, j) in opposites
        mover = j if is_opposite and a != INSIDE else i
        z, d, s, q, u = evidence.z(a, i, j), evidence.d(a, i, j), 0.0, 0.0, 0.0
        if a in LATERAL:
            kind = BESIDE
        elif a == ON_TOP and is_opposite:
            if not evidence.moves[j]:
                continue
            kind = BELOW
            z = max(z, evidence.z(ABOVE, i, j))
            if places is not None:
                classes = evidence.classes
                z = max(z, places.under_evidence(int(classes[i]), int(classes[j])))
            z, u = evidence.known_and_unknown((a, i, j), UNDER, z, j, i)
        elif a == ABOVE:
            kind = OVER_IT
            if i in supported:
                z = max(z, EXPLAINED)
            z, u = evidence.known_and_unknown((a, i, j), OVER, z, i, j)
        else:
            kind, q = SUPPORT, evidence.q(i, j)
            z, u = evidence.support(a, i, j)
            s = float(np.log(max(evidence.stands[i, SUPPORTED], _LEAST_P)))
        if not evidence.moves[mover]:
            s = q = 0.0
        if evidence.is_confirmed(a, i, j):
            z, d, s, q, u = EXPLAINED, 0.0, 0.0, 0.0, 0.0
        yield a, i, j, kind, max(z, LEAST_Z), d, s, q, u, mover


def _posed(model: SceneModel, posterior: Posterior, scene: Scene) -> Iterator[_Entry]:
    """Yield the entry of each object with a box, without stacks of one class."""
    if model.places is None:
        return
    evidence, holding = _Evidence(model, posterior), {*scene.triples}
    at = _standing(model, model.places, scene, evidence)
    for i, (reason, j) in enumerate(zip(at.reason.tolist(), at.anchor.tolist(), strict=True)):
        on_object = reason == ON_OBJECT
        if reason < 0 or not evidence.is_thing[i]:
            continue
        if not on_object:
            if evidence.moves[i]:
                relation, kind, _ = _REASONS[reason]
                yield relation, i, j, kind, 0.0, 0.0, -at.log_ratio[i], 0.0, 0.0, i
            continue
        if evidence.classes[i] == evidence.classes[j]:
            continue  # a stack of one class, as in `_stated`
        a = INSIDE if (INSIDE, i, j) in holding else ON_TOP
        r, (z, u) = at.held[i], evidence.support(a, i, j)
        z, d, q, u = r * z, r * evidence.d(a, i, j), r * evidence.q(i, j), r * u
        s = -at.log_ratio[i]
        if not evidence.moves[i]:
            s = q = 0.0
        if evidence.is_confirmed(a, i, j):
            z, d, s, q, u = EXPLAINED, 0.0, 0.0, 0.0, 0.0
        yield a, i, j, HELD, z, d, s, q, u, i


def _standing(model: SceneModel, places: Places, scene: Scene, evidence: _Evidence) -> Standing:
    """Return what the boxes of a scene say. Furniture whose lower part is hidden reaches the floor.

    Such a box is lower than usual, and its top is at the usual height. If no whole box shows the
    floor, boxes of at most half of the usual height show it by their tops.
    """
    vocabulary, shares = model.vocabulary, evidence.stands
    centres, extents = boxes_of(scene.objects, vocabulary.sizes)
    errors = errors_of(scene.objects, extents, evidence.classes, model.spread)
    usual_height = vocabulary.sizes[evidence.classes, 2]
    bottoms, tops = (centres[:, 2] + side * extents[:, 2] / 2 for side in (-1, 1))
    on_floor, std = np.ascontiguousarray(shares[:, FLOOR]), errors[:, 1].copy()
    is_furniture = evidence.is_thing & (on_floor >= USUAL)
    is_top = is_furniture & (extents[:, 2] < usual_height / 2)
    bottoms[~evidence.is_thing] = np.nan
    floor = floor_level(np.where(is_top, np.nan, bottoms), on_floor, std)
    if np.isnan(floor):
        floor = floor_level(np.where(is_top, tops - usual_height, bottoms), on_floor, std)
    is_hidden = is_furniture & (extents[:, 2] < _PARTIAL * usual_height)
    is_hidden &= np.abs(tops - floor - usual_height) <= _LIKE * usual_height
    longer = np.where(is_hidden, np.fmax(bottoms - floor, 0.0), 0.0)
    centres[:, 2] -= longer / 2
    extents[:, 2] += longer
    yaws = np.array([thing.yaw for thing in scene.objects])
    boxes = centres, extents, yaws, errors
    in_scene = shares_in_scene(np.concatenate([evidence.supporters, evidence.any_supporters]))
    supporters = in_scene[:, [*evidence.row, -1]]
    within, closed = places.within[evidence.classes], model.containers[evidence.classes]
    of_objects = np.ascontiguousarray(supporters), within.astype(np.float64), closed
    return Standing(*standing(boxes, floor, shares, *of_objects))


def wrong_log_odds(judgement: Judgement, terms: Float[Floats, "n 6"]) -> Float[Floats, "n"]:
    """Return the log-odds that entries of one kind are wrong."""
    weights = np.array([getattr(judgement, name) for name in WEIGHTS])
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
    model: SceneModel,
    posterior: Posterior,
    scene: Scene,
    sensitivity: Sensitivity,
    real: Float[NDArray[np.floating], "N"],  # probability of each object, see `doubt`
) -> list[Fields]:
    """Judge the stated relations, or the places of boxes.

    Every stated relation, and every support of boxes, of a kind that the model judges is listed,
    without structure and stacks of one class. Other entries about boxes need at least
    `LEAST_LISTED`, or an alarm. A wrong detection raises no alarm. The most probably wrong entry
    comes first. Equal probabilities keep
    the order of `Scene.triples`, or of the objects. An object under another object is the subject
    of its entry. `scene_client.schemas.MisplacedRelation` defines the fields.
    """
    entries = entries_of(model, posterior, scene)
    n = len(entries.kind)
    if not n:
        return []
    log_odds, line = np.full(n, -np.inf), np.full(n, np.inf)
    for judgement, rows, values in _judged(model, entries):
        log_odds[rows] = values
        line[rows] = getattr(judgement.lines, sensitivity).threshold(len(rows))
    always = (entries.kind < POSED) | (entries.kind == HELD)
    p, is_relation = sigmoid(log_odds), always & (log_odds > -np.inf)
    order = np.argsort(-log_odds, kind="stable")
    order = order[(is_relation | (p >= np.minimum(line, LEAST_LISTED)))[order]]
    ids = [thing.id for thing in scene.objects]
    is_misplaced = (p >= line) & (real[entries.mover] >= LEAST_REAL)
    columns = (
        *(entries.triple[order].tolist(), entries.kind[order].tolist()),
        *(significant(p[order]), is_misplaced[order].tolist(), entries.mover[order].tolist()),
    )
    fields: list[Fields] = []
    for (relation, subject, object_), kind, probability, is_alarm, mover in zip(
        *columns, strict=True
    ):
        name = CANONICAL[relation]
        if kind == BELOW or (relation, subject, object_) in scene.opposites:
            subject, name, object_ = object_, opposite(name), subject
        fields.append(
            {
                "subject": ids[subject],
                "relation": name,
                "object": ids[object_] if object_ >= 0 else THE_FLOOR,
                "probability": probability,
                "is_misplaced": is_alarm,
                "reason": _REASON_OF.get((relation, kind), "relation"),
                "moved": ids[mover],
            }
        )
    return fields
