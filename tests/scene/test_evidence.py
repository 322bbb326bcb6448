"""Evidence about classes: the pooled evidence about their instances."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from app.scene import (
    CANONICAL,
    PoseRelations,
    Scene,
    SceneObject,
    instance_evidence,
)
from app.scene.relations import LEFT, ON_TOP
from app.scene.scene import pool_classes
from training.datasets.encoding import pool_instances

A = len(CANONICAL)


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
    evidence = pool_instances(classes, holds, observed, room_type=3)
    *_, presence = pool_classes(classes, confidence)
    assert evidence.room_type == 3
    assert evidence.classes.tolist() == sorted(set(classes.tolist()))
    assert evidence.counts.tolist() == [(classes == c).sum() for c in evidence.classes]
    for x, c in enumerate(evidence.classes):
        members = np.flatnonzero(classes == c)
        assert presence[x] == pytest.approx(1 - np.prod(1 - confidence[members]))
        for y, d in enumerate(evidence.classes):
            pairs = [(i, j) for i in members for j in np.flatnonzero(classes == d) if i != j]
            for a in range(A):
                on = any(holds[a, i, j] for i, j in pairs)
                assert evidence.holds[a, x, y] == on
                observes = on or any(observed[a, i, j] for i, j in pairs)
                assert evidence.observed[a, x, y] == observes


def test_the_evidence_about_instances_is_stated_complete_or_from_poses() -> None:
    things = tuple(SceneObject(str(k), "x", 0) for k in range(3))
    triples = ((ON_TOP, 1, 0), (LEFT, 1, 2))
    holds, observed = instance_evidence(Scene(things, relations=triples))
    assert np.argwhere(holds).tolist() == [[LEFT, 1, 2], [ON_TOP, 1, 0]]
    assert not observed.any()
    stated, observed = instance_evidence(Scene(things, relations=triples, relations_complete=True))
    assert (stated == holds).all()
    assert observed.all()
    poses = PoseRelations(holds, np.roll(holds, 1))
    of_poses = instance_evidence(Scene(things, relations=((LEFT, 0, 1),), poses=poses))
    assert of_poses == (poses.holds, poses.observed)
