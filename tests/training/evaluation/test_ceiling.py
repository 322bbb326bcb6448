"""How far two scans of one room agree, by hand."""

from __future__ import annotations

import numpy as np
import pytest

from scripts.ceiling import agreement
from tests.training.evaluation.scenes import scene

STRUCTURE = np.zeros(6, dtype=np.bool_)


def test_scans_that_are_alike_agree_wholly():
    scans = [scene([0, 1, 2], [(0, 0, 1), (2, 2, 1)], group="a", name=name) for name in "xy"]
    found = agreement(scans, STRUCTURE)
    assert found["scans"] == 2
    assert found["R-precision, all triples"] == 1.0
    # Two of 3·2 ordered pairs × 4 relations; a removed class is all that the other scan still has.
    assert found["R-precision of chance"] == pytest.approx(2 * 2 / 24 / 2)
    assert found["MRR"] == 1.0


def test_what_the_other_scan_lacks_comes_in_random_order():
    """x lists left(0, 1), y lists front(0, 1): what y offers is wrong, and takes x's one guess."""
    scans = [
        scene([0, 1], [(0, 0, 1)], group="a", name="x"),
        scene([0, 2], [(1, 0, 2)], group="a", name="y"),
        scene([0, 1], [(0, 0, 1)], group="alone", name="z"),
    ]
    found = agreement(scans, STRUCTURE)
    assert found["scans"] == 2
    # No class pair is in both: one triple of 2 × 4 candidates by chance.
    assert found["R-precision, all triples"] == pytest.approx(1 / 8)
    # 0 is offered beside one wrong class; 1 (or 2) comes after that one wrong class, among the
    # other 4 of the 5 absent ones.
    wanted = (1 + 1 / 2) / 2, np.mean([1 / 2, 1 / 3, 1 / 4, 1 / 5])
    assert found["MRR"] == pytest.approx(np.mean(wanted))
