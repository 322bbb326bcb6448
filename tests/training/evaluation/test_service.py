"""Which scenes can be posted as single instances; what the service itself says is in test_cli."""

from __future__ import annotations

import numpy as np

from tests.training.evaluation.scenes import NO_STRUCTURE, scene, tensors
from training.evaluation.outliers import IntruderScores
from training.evaluation.service import Asked, metrics

_NONE = np.zeros(0, dtype=np.int64)
NO_INTRUDERS = IntruderScores(
    scene=_NONE,
    log_odds=_NONE.astype(float),
    intruder=_NONE.astype(bool),
    size=_NONE,
    clean=_NONE.astype(bool),
    thing=_NONE,
    scenes=1,
    skipped=1,
)


def told(scenes, structure=NO_STRUCTURE):
    """The triples that T1b and T3b state, each scene's as a set of (a, x, y) positions."""
    stated = []

    def relations(batch):
        stated.extend({tuple(t) for t in given.nonzero().tolist()} for given in batch.holds)
        return batch.holds.double()

    def nothing(v):
        return v.double() * 0

    asked = Asked(
        objects=nothing,
        relations=relations,
        stated=relations,
        placed=lambda places: nothing(places.v),
        intruders=lambda *_: (NO_INTRUDERS, np.zeros(0, dtype=np.bool_)),
    )
    found = metrics(asked, tensors(scenes), structure)
    assert ("T1b R-precision" in found) == ("T3b hit@1" in found) == bool(any(stated))
    return [triples for triples in stated if triples]


BOTH_WAYS = [(0, 0, 1), (0, 1, 0), (1, 1, 2), (2, 0, 2)]
ONE_WAY = [(0, 0, 1), (1, 1, 2), (2, 0, 2)]


def test_single_instances_cannot_stand_both_ways_round():
    assert told([scene([0, 1, 2], ONE_WAY)])
    assert not told([scene([0, 1, 2], BOTH_WAYS)])


def test_two_of_one_class_are_no_contradiction():
    """left(chair, chair) holds between instances and is never asked about."""
    found = scene([0, 0, 1, 2], ONE_WAY)
    found.evidence.holds[0, 0, 0] = True
    assert told([found])


def test_structure_is_no_contradiction_either():
    structure = NO_STRUCTURE.clone()
    structure[3] = True
    assert told([scene([0, 1, 2, 3], [*ONE_WAY, (0, 0, 3), (0, 3, 0)])], structure)
