"""Which drawn relations stay: they can hold all at once, and none is left out without need."""

from __future__ import annotations

from graphlib import CycleError, TopologicalSorter

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from app.questions.generate import staying
from app.scene.relations import ABOVE, FRONT, LEFT, ON_TOP

V = 6
TRIPLES = st.tuples(
    st.sampled_from([ON_TOP, ABOVE, LEFT, FRONT]), st.integers(0, V - 1), st.integers(0, V - 1)
)
DRAWN = st.dictionaries(TRIPLES, st.sampled_from([-1.0, 0.0, 0.5, 2.0]), max_size=24)
NONE = np.zeros(V, dtype=np.bool_)


def possible(triples):
    """One relation a pair, one support a class, and an order of the classes in each direction."""
    pairs = [frozenset((i, j)) for _, i, j in triples]
    if len(set(pairs)) < len(pairs) or any(len(pair) == 1 for pair in pairs):
        return False
    supported = [i for a, i, _ in triples if a == ON_TOP]
    if len(set(supported)) < len(supported):
        return False
    try:
        for direction in ({ON_TOP, ABOVE}, {LEFT}, {FRONT}):
            graph = {}
            for a, i, j in triples:
                if a in direction:
                    graph.setdefault(i, set()).add(j)
            TopologicalSorter(graph).prepare()
    except CycleError:
        return False
    return True


def kept(likelihood, fixed=frozenset(), structure=NONE):
    units = np.array(list(likelihood), dtype=np.int64).reshape(-1, 3)
    logits = np.array(list(likelihood.values()), dtype=np.float32)
    stay = staying(units, logits, fixed, structure)
    return {triple for triple, stays in zip(likelihood, stay.tolist(), strict=True) if stays}


@given(DRAWN)
def test_kept_relations_are_consistent_and_removed_ones_are_not(likelihood):
    """Each one that goes contradicts those that are at least as likely and stay."""
    stay = kept(likelihood)
    assert possible(stay)
    for triple in set(likelihood) - stay:
        likelier = {one for one in stay if likelihood[one] >= likelihood[triple]}
        assert not possible(likelier | {triple})


@given(DRAWN, st.sets(TRIPLES, max_size=4))
def test_given_relations_stay_and_exclude_others(likelihood, fixed):
    stay = kept(likelihood, fixed)
    assert fixed & set(likelihood) <= stay
    for triple in stay - fixed:
        assert all({*triple[1:]} != {*one[1:]} for one in fixed)
    if possible(fixed):
        assert possible(stay | fixed)


@given(DRAWN, st.lists(st.booleans(), min_size=V, max_size=V))
def test_structure_stands_in_no_relation(likelihood, structure):
    stay = kept(likelihood, structure=np.array(structure))
    assert stay == kept(
        {t: z for t, z in likelihood.items() if not structure[t[1]] and not structure[t[2]]}
    )
