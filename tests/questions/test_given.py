"""Given relations in lists against the evidence that training reads, and classes against it."""

from __future__ import annotations

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from app.questions.posterior import given_relations, present
from app.scene import Scene, SceneObject, derive_relations
from app.scene.evidence import class_evidence
from training.machines import MachineSpec

SPEC = MachineSpec("triway", V=5, A=4, H1=3, K=2, form="local")


@st.composite
def scenes(draw):
    classes = draw(st.lists(st.integers(0, 4), max_size=7))
    sure = draw(st.lists(st.floats(0.05, 1.0), min_size=len(classes), max_size=len(classes)))
    objects = tuple(
        SceneObject(str(k), "x", c, p) for k, (c, p) in enumerate(zip(classes, sure, strict=True))
    )
    n = len(classes)
    kind = draw(st.sampled_from(["bare", "stated", "complete", "shown"]))
    if kind == "bare":
        return Scene(objects)
    if kind == "shown":
        axis = st.floats(0, 3)
        places = draw(st.lists(st.tuples(axis, axis, axis), min_size=n, max_size=n))
        poses = derive_relations(np.array(places).reshape(n, 3), np.full((n, 3), 0.5))
        return Scene(objects, poses=poses)
    units = [(a, x, y) for a in range(4) for x in range(n) for y in range(x)]
    triples = draw(st.lists(st.sampled_from(units), unique=True)) if units else []
    return Scene(objects, tuple(triples), kind == "complete")


@given(scenes(), st.integers(1, 4))
@settings(max_examples=300)
def test_lists_say_what_the_evidence_says(scene, relations):
    expected, found = class_evidence(scene), present(scene, SPEC)
    lists = given_relations(scene, found, relations)
    observed = expected.observed[:relations]
    if lists is None:
        assert not observed.any()
        return
    a, i, j = np.nonzero(observed)
    for name, wanted in (("a", a), ("i", i), ("j", j), ("r", expected.holds[a, i, j])):
        np.testing.assert_array_equal(getattr(lists, name), wanted)
    gate = expected.confidence[i] * expected.confidence[j]
    np.testing.assert_allclose(lists.g, gate, rtol=1e-6)


@given(scenes())
@settings(max_examples=200)
def test_classes_are_those_of_the_evidence(scene):
    expected, found = class_evidence(scene), present(scene, SPEC)
    np.testing.assert_array_equal(found.classes, expected.classes)
    np.testing.assert_array_equal(found.counts, expected.counts)
    np.testing.assert_allclose(found.presence, expected.confidence, rtol=1e-6)
    np.testing.assert_allclose(found.log_counts, np.log(expected.counts), rtol=1e-6)
    indices = [thing.class_index for thing in scene.objects]
    assert found.classes[found.row].tolist() == indices
    assert [indices.index(c) for c in found.classes.tolist()] == found.first.tolist()
