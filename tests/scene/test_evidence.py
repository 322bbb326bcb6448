from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from app.scene import CANONICAL, PoseRelations, Scene, SceneObject, class_evidence, pool_instances
from app.scene.relations import LEFT, ON_TOP

A = len(CANONICAL)


def things(*classes: int | None, confidence: float = 1.0) -> tuple[SceneObject, ...]:
    return tuple(SceneObject(str(i), "x", c, confidence) for i, c in enumerate(classes))


@st.composite
def instances(draw: st.DrawFn) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    size = draw(st.integers(0, 6))
    classes = draw(hnp.arrays(np.int64, size, elements=st.integers(0, 3)))
    confidence = draw(hnp.arrays(float, size, elements=st.floats(0.01, 1)))
    holds = draw(hnp.arrays(bool, (A, size, size)))
    return classes, confidence, holds, draw(hnp.arrays(bool, (A, size, size)))


@given(instances())
def test_classes_are_the_or_over_instance_pairs(
    drawn: tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray],
) -> None:
    classes, confidence, holds, observed = drawn
    found = pool_instances(*drawn, room_type=3)
    assert found.room_type == 3
    assert found.classes.tolist() == sorted(set(classes.tolist()))
    assert found.counts.tolist() == [(classes == c).sum() for c in found.classes]
    for x, c in enumerate(found.classes):
        members = np.flatnonzero(classes == c)
        assert found.confidence[x] == pytest.approx(1 - np.prod(1 - confidence[members]))
        for y, d in enumerate(found.classes):
            pairs = [(i, j) for i in members for j in np.flatnonzero(classes == d) if i != j]
            for a in range(A):
                on = any(holds[a, i, j] for i, j in pairs)
                assert found.holds[a, x, y] == on
                assert found.observed[a, x, y] == (on or any(observed[a, i, j] for i, j in pairs))


def test_given_relations_are_on_and_the_rest_unobserved() -> None:
    found = class_evidence(Scene(things(7, 2, 2), relations=((ON_TOP, 1, 0),), room_type=1))
    assert found.classes.tolist() == [2, 7]
    assert found.counts.tolist() == [2, 1]
    assert np.argwhere(found.holds).tolist() == [[ON_TOP, 0, 1]]
    assert (found.observed == found.holds).all()
    assert found.room_type == 1


def test_complete_relations_observe_every_pair_of_instances() -> None:
    scene = Scene(things(7, 2, 2), relations=((LEFT, 1, 2),), relations_complete=True)
    found = class_evidence(scene)
    assert np.argwhere(found.holds).tolist() == [[LEFT, 0, 0]]
    assert found.observed[:, 0].all()
    assert found.observed[:, 1, 0].all()
    # A single instance has no pair with itself.
    assert not found.observed[:, 1, 1].any()


def test_poses_observe_off_where_an_instance_pair_was_in_range() -> None:
    holds, observed = np.zeros((A, 3, 3), bool), np.zeros((A, 3, 3), bool)
    observed[:, 0, 1] = observed[:, 1, 0] = True  # the second instance of class 2 is far away
    holds[LEFT, 0, 1] = True
    scene = Scene(things(7, 2, 2), relations=((LEFT, 0, 1),), poses=PoseRelations(holds, observed))
    found = class_evidence(scene)
    assert np.argwhere(found.holds).tolist() == [[LEFT, 1, 0]]
    assert found.observed[:, 0, 1].all()
    assert found.observed[:, 1, 0].all()
    assert not found.observed[:, 0, 0].any()


def test_things_outside_the_vocabulary_are_left_out() -> None:
    scene = Scene(things(None, 4, None, 1), relations=((LEFT, 0, 1), (LEFT, 3, 1)))
    found = class_evidence(scene)
    assert found.classes.tolist() == [1, 4]
    assert np.argwhere(found.holds).tolist() == [[LEFT, 0, 1]]
    assert class_evidence(Scene(things(None))).classes.shape == (0,)


def test_shapes_are_checked() -> None:
    nothing = np.zeros((A, 2, 2), bool)
    with pytest.raises(ValueError, match=rf"holds must have the shape \({A}, 1, 1\)"):
        pool_instances(np.array([0]), np.ones(1), nothing, nothing)
    with pytest.raises(ValueError, match="confidence must have the shape"):
        pool_instances(np.array([0, 1]), np.ones(1), nothing, nothing)
