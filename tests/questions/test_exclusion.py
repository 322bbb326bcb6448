"""Drawn relations that stay: no contradictions, and no relation removed without a reason."""

from __future__ import annotations

from graphlib import CycleError, TopologicalSorter

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from app.questions.generate import staying
from app.scene.relations import ABOVE, FRONT, LEFT, ON_TOP

V = 6
CLASSES = st.integers(0, V - 1)
TRIPLES = st.tuples(st.sampled_from([ON_TOP, ABOVE, LEFT, FRONT]), CLASSES, CLASSES)
DRAWN = st.dictionaries(TRIPLES, st.sampled_from([-1.0, 0.0, 0.5, 2.0]), max_size=24)


def is_possible(triples):
    """One relation per pair, one support per class, and no cycle in any direction."""
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


def kept(drawn, evidence=frozenset(), structure=(False,) * V):
    units = np.array(list(drawn), dtype=np.int64).reshape(-1, 3)
    logits = np.array(list(drawn.values()), dtype=np.float32)
    stay = staying(units, logits, evidence, np.array(structure))
    return {triple for triple, stays in zip(drawn, stay.tolist(), strict=True) if stays}


@given(DRAWN)
def test_kept_relations_are_possible_and_removed_relations_contradict_likelier_ones(drawn):
    stay = kept(drawn)
    assert is_possible(stay)
    for triple in drawn.keys() - stay:
        likelier = {other for other in stay if drawn[other] >= drawn[triple]}
        assert not is_possible(likelier | {triple})


@given(DRAWN, st.sets(TRIPLES, max_size=4))
def test_the_evidence_stays_and_excludes_other_relations(drawn, evidence):
    stay = kept(drawn, evidence)
    assert evidence & drawn.keys() <= stay
    for _, *ends in stay - evidence:
        assert all({*ends} != {*other[1:]} for other in evidence)
    if is_possible(evidence):
        assert is_possible(stay | evidence)
