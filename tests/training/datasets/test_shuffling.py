"""Permutation of objects between scenes."""

from __future__ import annotations

from collections import Counter
from typing import Any

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from app.scene import CANONICAL
from app.scene.stands import UNKNOWN
from training.datasets import EncodedScene, shuffle_objects
from training.datasets.encoding import ClassEvidence, pool_instances

V = 9
STRUCTURE = np.arange(V) >= 7
A = len(CANONICAL)


def made(
    instances: list[int], number: int, room: int = -1, source: str = "s", unknown: tuple = ()
) -> EncodedScene:
    """A scene of instances with random relations; structure has none."""
    rng = np.random.default_rng(number)
    classes = np.array(instances, dtype=np.int64)
    thing = ~STRUCTURE[classes]
    pairs = thing[:, None] & thing & ~np.eye(len(classes), dtype=np.bool_)
    observed = pairs & (rng.random((A, len(classes), len(classes))) < 0.6)
    holds = observed & (rng.random(observed.shape) < 0.4)
    evidence = pool_instances(classes, holds, observed, None if room < 0 else room)
    stands = np.full(len(classes), UNKNOWN)
    return EncodedScene(
        *(str(number), source, f"group {number}", room, evidence),
        *(classes, holds, observed, unknown, stands),
    )


@st.composite
def scene_sets(draw: Any) -> list[EncodedScene]:
    rooms = st.integers(-1, 3)
    instances = st.lists(st.integers(0, V - 1), max_size=12)
    some = draw(st.lists(st.tuples(instances, rooms, st.sampled_from("st")), max_size=12))
    return [made(own, k, room, source, (str(k),)) for k, (own, room, source) in enumerate(some)]


def presence(scenes: list[EncodedScene]) -> np.ndarray:
    """Number of entries of each class in each scene, (scenes, V)."""
    rows = [np.bincount(scene.evidence.classes, minlength=V) for scene in scenes]
    return np.array(rows).reshape(-1, V)


def slots(evidence: ClassEvidence) -> list[tuple[int, int, int]]:
    """Count and number of relations of each slot."""
    numbers = evidence.counts, evidence.holds.sum((0, 1)), evidence.observed.sum((0, 1))
    return sorted(zip(*(array.tolist() for array in numbers), strict=True))


seeds = st.integers(0, 2**32 - 1)


@settings(deadline=None)
@given(scene_sets(), seeds)
def test_both_margins_are_kept_exactly(scenes, seed):
    before, after = presence(scenes), presence(shuffle_objects(scenes, STRUCTURE, seed))
    assert after.max(initial=0) <= 1, "a class is in a scene once"
    np.testing.assert_array_equal(after.sum(0), before.sum(0))
    for kind in (STRUCTURE, ~STRUCTURE):
        np.testing.assert_array_equal(after[:, kind].sum(1), before[:, kind].sum(1))


@settings(deadline=None)
@given(scene_sets(), seeds)
def test_shuffled_scenes_are_valid_and_keep_other_fields(scenes, seed):
    """Relations and counts move with the slots: pooling the instances anew gives the evidence."""
    after = shuffle_objects(scenes, STRUCTURE, seed)
    assert Counter(s.room_type for s in after) == Counter(s.room_type for s in scenes)
    for old, new in zip(scenes, after, strict=True):
        e = new.evidence
        assert e.classes.dtype == new.instance_classes.dtype == np.int64
        assert (np.diff(e.classes) > 0).all()
        assert not (e.holds & ~e.observed).any()
        assert slots(e) == slots(old.evidence)
        apart = STRUCTURE[e.classes]
        assert not e.observed[:, apart].any()
        assert not e.observed[:, :, apart].any()
        for name in ("scene_id", "source", "group", "unknown"):
            assert getattr(new, name) == getattr(old, name)
        assert new.instance_holds is old.instance_holds
        assert (new.room_type < 0) is (old.room_type < 0)
        assert e.room_type == (None if new.room_type < 0 else new.room_type)
        pooled = pool_instances(new.instance_classes, new.instance_holds, new.instance_observed)
        for name in ("classes", "counts", "holds", "observed"):
            np.testing.assert_array_equal(getattr(pooled, name), getattr(e, name))


def test_every_table_of_the_margins_is_equally_likely():
    """{0}, {1, 2}: three tables have these margins, each with a third of 3,000 seeds.

    Six standard deviations, sqrt(3000 · 2/9) = 26: less than one of 10^8 correct programs fails.
    """
    scenes = [made([0], 0), made([1, 2], 1)]
    found = Counter(
        int(shuffle_objects(scenes, STRUCTURE, seed)[0].evidence.classes[0]) for seed in range(3000)
    )
    assert set(found) == {0, 1, 2}
    assert all(abs(count - 1000) < 6 * 26 for count in found.values())
