"""Counts and offsets in an artifact: they come back as written, and invalid tensors are refused."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from app.registry import Artifact, ArtifactError, Counts, Offsets, load_artifact, write_artifact
from tests.registry.small_artifacts import description, refused, state

A, V, C, M = 5, 3, 2, 4  # A, V and C as in `small_artifacts`
BESIDE, ON_IT = (0, 1, 0.5, 0.5, 0.5, 0.25), (0, 0, 0.75, 0.5, 0.25, 0.125)


def counts(**changes: np.ndarray) -> Counts:
    """Of the classes bed and lamp."""
    weights = np.full((2, 2, 3 + C + V), 0.25, np.float32)
    weights[0, :, 3 + C] = weights[1, :, 4 + C] = 0
    values = {
        "classes": np.array([0, 1]),
        "most": np.array([1, M - 1]),
        "log_share": np.full((2, M), -1.5, np.float32),
        "weights": weights,
    }
    return Counts(**(values | changes))


def offsets(**changes: np.ndarray) -> Offsets:
    """Of two relations; a lamp (1) on a bed (0) was seen in 12 scenes, a lamp beside it in one."""
    relation = np.zeros((A, 6), np.float32)
    relation[0], relation[2] = (0, 0.75, 0, 0.25, 0.25, 0.25), (0, 0, 0.5, 0.25, 0.25, 0.0625)
    subject, other = np.zeros((A, V, 6), np.float32), np.zeros((A, V, 6), np.float32)
    subject[2, 1] = (0, 0, 0.25, 0, 0, -0.03125)
    other[2, 0] = (0, 0, 0.125, -0.1875, 0, 0)
    values = {
        "relation": relation,
        "relation_scenes": np.array([3, 0, 20, 0, 0], np.int32),
        "subject": subject,
        "object": other,
        "pair": np.array([(0 * V + 1) * V + 0, (2 * V + 1) * V + 0], np.int64),
        "pair_offset": np.array([BESIDE, ON_IT], np.float32),
        "pair_scenes": np.array([1, 12], np.int32),
    }
    return Offsets(**(values | changes))


def written(directory: Path, table: Counts | Offsets) -> Artifact:
    tensors = state() | table.tensors()
    write_artifact(directory, description(), tensors, storage_dtype="float16")
    return load_artifact(directory)


@pytest.mark.parametrize(
    ("table", "line"),
    [
        (counts(), "| Counts | of instances, for 2 classes |"),
        (offsets(), "| Offsets | in metres, of 2 pairs of classes |"),
    ],
)
def test_they_come_back_with_the_artifact(
    tmp_path: Path, table: Counts | Offsets, line: str
) -> None:
    artifact = written(tmp_path / "a", table)
    tables = {Counts: artifact.counts, Offsets: artifact.offsets}
    loaded = tables.pop(type(table))
    assert loaded is not None
    assert [*tables.values()] == [None]
    for name, tensor in table.tensors().items():
        assert np.array_equal(loaded.tensors()[name], tensor)
    assert artifact.manifest.weights.keys() == state().keys()
    assert line in artifact.card


INVALID_COUNTS = [
    ({"weights": np.zeros((2, 2, 2 + C + V), "f4")}, "wrong_shape"),
    ({"log_share": np.float32(-1)}, "wrong_shape"),
    ({"classes": np.int64(0)}, "wrong_shape"),
    ({"classes": np.array([0.0, 1.0], "f4")}, "invalid_tensor"),
    ({"classes": np.array([1, 0])}, "invalid_tensor"),
    (
        {
            "classes": np.zeros(0, np.int64),
            "most": np.zeros(0, np.int64),
            "log_share": np.zeros((0, M), "f4"),
            "weights": np.zeros((0, 2, 3 + C + V), "f4"),
        },
        "invalid_tensor",
    ),
    ({"classes": np.array([0, 0])}, "invalid_tensor"),
    ({"classes": np.array([-1, 1])}, "invalid_tensor"),
    ({"classes": np.array([0, V])}, "invalid_tensor"),
    ({"classes": np.array([0, -(2**63)])}, "invalid_tensor"),
    ({"most": np.array([1.0, 2.0], "f4")}, "invalid_tensor"),
    ({"most": np.array([0, 1])}, "invalid_tensor"),
    ({"most": np.array([1, M])}, "invalid_tensor"),
    ({"log_share": np.full((2, M), -1, "i4")}, "invalid_tensor"),
    ({"weights": np.zeros((2, 2, 3 + C + V), "i4")}, "invalid_tensor"),
    ({"log_share": np.full((2, 1), -1, "f4")}, "invalid_tensor"),
    ({"log_share": np.full((2, 300), -1, "f4")}, "invalid_tensor"),
    ({"log_share": np.full((2, M), 0.5, "f4")}, "invalid_tensor"),
    ({"log_share": np.full((2, M), -1e4, "f4")}, "invalid_tensor"),
    ({"weights": np.full((2, 2, 3 + C + V), 6e4, "f4")}, "invalid_tensor"),
    ({"weights": np.full((2, 2, 3 + C + V), 0.5, "f4")}, "invalid_tensor"),
    ({"weights": np.full((2, 2, 3 + C + V), np.nan, "f4")}, "not_finite"),
]
INVALID_OFFSETS = [
    ({"relation": np.zeros((A, 5), "f4")}, "wrong_shape"),
    ({"pair": np.int64(3)}, "wrong_shape"),
    ({"pair": np.array([20, 3], np.int64)}, "invalid_tensor"),
    ({"pair": np.array([3, 3], np.int64)}, "invalid_tensor"),
    ({"pair": np.array([-1, 3], np.int64)}, "invalid_tensor"),
    ({"pair": np.array([3, -(2**63)], np.int64)}, "invalid_tensor"),
    ({"pair": np.array([3, A * V * V], np.int64)}, "invalid_tensor"),
    ({"pair": np.array([3.0, 21.0], "f4")}, "invalid_tensor"),
    ({"pair_scenes": np.array([0, 12], np.int32)}, "invalid_tensor"),
    ({"relation_scenes": np.array([-1, 0, 0, 0, 0], np.int32)}, "invalid_tensor"),
    ({"pair_offset": np.zeros((2, 6), "f4")}, "invalid_tensor"),
    ({"relation": np.zeros((A, 6), "f4")}, "invalid_tensor"),
    ({"subject": np.full((A, V, 6), -1, "f4")}, "invalid_tensor"),
    ({"relation": np.full((A, 6), np.nan, "f4")}, "not_finite"),
]


@pytest.mark.parametrize(
    ("table", "change", "code"),
    [
        *((counts, change, code) for change, code in INVALID_COUNTS),
        *((offsets, change, code) for change, code in INVALID_OFFSETS),
    ],
)
def test_invalid_tensors_are_refused(tmp_path: Path, table, change: dict, code: str) -> None:
    with refused(code):
        written(tmp_path / "a", table(**change))


@pytest.mark.parametrize(("table", "sizes"), [(counts(), (V, C)), (offsets(), (A, V))])
def test_a_tensor_too_few_or_too_many_is_refused(
    table: Counts | Offsets, sizes: tuple[int, int]
) -> None:
    tensors = table.tensors()
    more = next(iter(tensors)).partition(".")[0] + ".more"
    with pytest.raises(ArtifactError) as raised:
        table.from_tensors({**tensors, more: np.zeros(2)}, *sizes)
    assert more in raised.value.reason
    for name in tensors:
        with pytest.raises(ArtifactError):
            table.from_tensors({n: t for n, t in tensors.items() if n != name}, *sizes)


# -- what offsets say ----------------------------------------------------------------------------


def offset_of(relation: int, subject: int, other: int) -> tuple[list[float], int]:
    values, scenes = offsets().find(np.array([relation]), np.array([subject]), np.array([other]))
    return values[0].tolist(), int(scenes[0])


def test_a_pair_that_was_seen_has_its_own_offset() -> None:
    assert offset_of(2, 1, 0) == (list(ON_IT), 12)
    assert offset_of(0, 1, 0) == (list(BESIDE), 1)


def test_a_pair_never_seen_has_what_relation_and_classes_say_together() -> None:
    assert offset_of(2, 2, 2) == ([0, 0, 0.5, 0.5, 0.5, 0.25], 0)
    assert offset_of(2, 1, 2)[0] == pytest.approx([0, 0, 0.75, 0.5, 0.5, np.sqrt(0.03125)])
    assert offset_of(2, 2, 0) == ([0, 0, 0.625, 0.25, 0.5, 0.25], 0)


def test_a_relation_that_no_scene_showed_means_nothing() -> None:
    assert offset_of(1, 1, 0)[1] == offset_of(3, 0, 2)[1] == -1


def test_without_a_pair_there_is_still_the_relation() -> None:
    nothing = np.zeros(0, np.int64)
    bare = offsets(pair=nothing, pair_offset=np.zeros((0, 6), "f4"), pair_scenes=nothing)
    values, scenes = bare.find(np.array([2]), np.array([2]), np.array([2]))
    assert (values[0].tolist(), scenes.tolist()) == ([0, 0, 0.5, 0.5, 0.5, 0.25], [0])
    assert Offsets.from_tensors(bare.tensors(), A, V).pair.shape == (0,)
