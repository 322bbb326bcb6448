"""Placements in metres: the right way round, in the right frame, and nothing where nobody looks."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import NamedTuple

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from app.questions.placements import offsets_of
from app.registry import Offsets
from app.registry.offsets import UNOBSERVED
from app.scene import CANONICAL, Scene, SceneObject
from app.scene.geometry import viewer_axes
from app.scene.relations import ABOVE, FRONT, LEFT, ON_TOP, canonicalise
from tests.questions.answers import missing
from tests.questions.artifacts import LARGER, larger_artifact

V = LARGER["triway-local"].V
A = len(CANONICAL)


def known(V: int = V) -> Offsets:
    """Every pair has an offset of its own, drawn."""
    rng = np.random.default_rng(0)
    nothing = np.zeros((A, V, 6), np.float32)
    spread = rng.uniform(0.1, 0.6, (A * V * V, 3))
    return Offsets(
        relation=np.concatenate([rng.normal(size=(A, 3)), np.full((A, 3), 0.25)], 1).astype("f4"),
        relation_scenes=np.full(A, 9),
        subject=nothing,
        object=nothing,
        pair=np.arange(A * V * V),
        pair_offset=np.concatenate([rng.normal(size=(A * V * V, 3)), spread], 1).astype("f4"),
        pair_scenes=np.arange(1, A * V * V + 1),
    )


class Offset(NamedTuple):
    """Mean and standard deviation in metres, and the number of training scenes."""

    mean: tuple[float, float, float]
    std: tuple[float, float, float]
    scenes: int


OFFSETS = known()
VIEWER = viewer_axes()


def one(relation, missing, anchor, outgoing=True, axes=VIEWER, offsets=OFFSETS):
    """The offset of one placement, or None if it is unknown."""
    ends = (np.array([value]) for value in (relation, missing, anchor, outgoing))
    mean, std, scenes = (values[0].tolist() for values in offsets_of(offsets, *ends, axes))
    return None if scenes == UNOBSERVED else Offset(tuple(mean), tuple(std), scenes)


@given(st.integers(0, A - 1), st.integers(0, V - 1), st.integers(0, V - 1))
def test_opposite_relations_have_negative_offsets(a, i, j):
    """left(i, j) and right(j, i) are one fact, asked from either end."""
    to, back = one(a, i, j), one(a, j, i, outgoing=False)
    assert back.mean == tuple(-x for x in to.mean)
    assert (back.std, back.scenes) == (to.std, to.scenes)


@given(st.floats(-7, 7), st.booleans())
def test_a_turn_of_the_viewer_turns_the_offset(yaw, optical):
    plain = one(LEFT, 1, 2)
    frame = "camera_optical_frame" if optical else "map"
    found = one(LEFT, 1, 2, axes=viewer_axes(frame, yaw))
    x, y, z = plain.mean
    c, s = math.cos(yaw), math.sin(yaw)
    turned = (c * x - s * y, s * x + c * y, z)
    if optical:
        turned = (-turned[1], -turned[2], turned[0])
    assert found.mean == pytest.approx(turned, abs=2e-3)
    # What is drawn around the plain mean and turned has the spread that is answered.
    drawn = np.random.default_rng(1).normal(plain.mean, plain.std, (20_000, 3))
    points = np.stack([c * drawn[:, 0] - s * drawn[:, 1], s * drawn[:, 0] + c * drawn[:, 1]], 1)
    spread = (*points.std(axis=0), plain.std[2])
    if optical:
        spread = (spread[1], spread[2], spread[0])
    # The standard error of a spread is half a percent.
    assert found.std == pytest.approx(spread, rel=0.03)


def test_where_nobody_looks_left_and_front_have_no_offset():
    assert one(LEFT, 1, 2, axes=None) is None
    assert one(FRONT, 1, 2, outgoing=False, axes=None) is None


@pytest.mark.parametrize("relation", [ON_TOP, ABOVE])
def test_where_nobody_looks_what_lies_on_a_thing_lies_in_no_direction_from_it(relation):
    """The spread is that of offsets turned by every angle alike."""
    plain, found = one(relation, 1, 2), one(relation, 1, 2, axes=None)
    rng = np.random.default_rng(1)
    drawn, angle = rng.normal(plain.mean, plain.std, (100_000, 3)), rng.uniform(0, 7e3, 100_000)
    x = np.cos(angle) * drawn[:, 0] - np.sin(angle) * drawn[:, 1]
    assert found.mean == (0.0, 0.0, plain.mean[2])
    assert found.std == pytest.approx((x.std(), x.std(), plain.std[2]), rel=0.02)


def test_no_zero_is_negative_and_no_spread_is_nothing():
    exact = replace(OFFSETS, pair_offset=np.tile(np.float32([0, 0, 0, 1e-6, 1, 1]), (A * V * V, 1)))
    found = one(LEFT, 1, 2, outgoing=False, offsets=exact)
    assert [math.copysign(1, x) for x in found.mean] == [1, 1, 1]
    assert found.std[0] == 0.001


def test_a_relation_without_poses_has_no_offset():
    some = np.array([1, 0, 9, 9])
    pairs = {"pair": np.zeros(0, np.int64), "pair_offset": np.zeros((0, 6), "f4")}
    partial = replace(OFFSETS, relation_scenes=some, pair_scenes=np.zeros(0, np.int64), **pairs)
    assert one(FRONT, 1, 2, offsets=partial) is None
    assert one(LEFT, 1, 2, offsets=partial).scenes == 0


@pytest.mark.parametrize("name", ["rbm", "triway-wide", "triway-local"])
def test_placements_have_the_offsets_of_their_classes(name):
    artifact = larger_artifact(name)
    centre = (0.0, 0.0, 0.0)
    things = tuple(
        SceneObject(str(k), "", index, position=centre) for k, index in enumerate((2, 0, 8, 2, 4))
    )
    scene = Scene(things)
    bare = missing(artifact, scene)
    answers = missing(replace(artifact, offsets=OFFSETS), scene)
    assert [entry.label for entry in answers] == [entry.label for entry in bare]
    places = 0
    for entry, before in zip(answers, bare, strict=True):
        label = artifact.vocabulary.index(entry.label)
        plain = [place._replace(offset=None) for place in entry.placements]
        assert plain == list(before.placements)
        for place in entry.placements:
            relation, subject, _ = canonicalise("missing", place.relation, "anchor")
            anchor = things[place.object].class_index
            expected = one(relation, label, anchor, subject == "missing")
            assert tuple(place.offset.mean) == expected.mean
            assert tuple(place.offset.std) == expected.std
            assert place.offset.scenes == expected.scenes
            places += 1
    assert places >= 3


def test_a_scene_of_structure_alone_has_no_placements():
    artifact = replace(larger_artifact("triway-local"), offsets=OFFSETS)
    answers = missing(artifact, Scene((SceneObject("0", "wall", 8),)))
    assert answers
    assert all(entry.placements == () for entry in answers)
