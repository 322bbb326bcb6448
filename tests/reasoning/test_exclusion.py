"""Which drawn relations stay, against the rule written out for one relation at a time."""

from __future__ import annotations

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from app.reasoning.exclusion import staying

V = 5
TRIPLES = st.tuples(st.integers(0, 1), st.integers(0, V - 1), st.integers(0, V - 1))


def stays(triple, likelihood, fixed, structure):
    a, i, j = triple
    mirrored = (a, j, i)
    if triple in fixed:
        return True
    if i == j or mirrored in fixed or structure[i] or structure[j]:
        return False
    if mirrored not in likelihood:
        return True
    return (likelihood[triple], -i) > (likelihood[mirrored], -j)


@given(
    st.dictionaries(TRIPLES, st.sampled_from([-1.0, 0.0, 0.5, 2.0])),
    st.sets(TRIPLES, max_size=4),
    st.lists(st.booleans(), min_size=V, max_size=V),
)
def test_as_one_by_one(likelihood, fixed, structure):
    units = np.array(list(likelihood), dtype=np.int64).reshape(-1, 3)
    logits = np.array(list(likelihood.values()), dtype=np.float32)
    found = staying(units, logits, fixed, np.array(structure))
    expected = [stays(triple, likelihood, fixed, structure) for triple in likelihood]
    assert found.tolist() == expected
