"""Offsets in an artifact: what they say, that they come back, and what is refused."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from app.registry import Artifact, ArtifactError, Offsets, load_artifact, write_artifact
from tests.registry.small_artifacts import description, state

A, V = 4, 3  # as in `small_artifacts`
BESIDE, ON_IT = (0, 1, 0.5, 0.5, 0.5, 0.25), (0, 0, 0.75, 0.5, 0.25, 0.125)


def offsets(**changes: np.ndarray) -> Offsets:
    """Of two relations; a lamp (1) on a bed (0) was seen in 12 scenes, a lamp beside it in one."""
    relation = np.zeros((A, 6), np.float32)
    relation[0], relation[2] = (0, 0.75, 0, 0.25, 0.25, 0.25), (0, 0, 0.5, 0.25, 0.25, 0.0625)
    subject, other = np.zeros((A, V, 6), np.float32), np.zeros((A, V, 6), np.float32)
    subject[2, 1] = (0, 0, 0.25, 0, 0, -0.03125)
    other[2, 0] = (0, 0, 0.125, -0.1875, 0, 0)
    values = {
        "relation": relation,
        "relation_scenes": np.array([3, 0, 20, 0], np.int32),
        "subject": subject,
        "object": other,
        "pair": np.array([(0 * V + 1) * V + 0, (2 * V + 1) * V + 0], np.int64),
        "pair_offset": np.array([BESIDE, ON_IT], np.float32),
        "pair_scenes": np.array([1, 12], np.int32),
    }
    return Offsets(**(values | changes))


def written(directory: Path, **changes: np.ndarray) -> Artifact:
    tensors = state() | offsets(**changes).tensors()
    write_artifact(directory, description(), tensors, storage_dtype="float16")
    return load_artifact(directory)


def found(relation: int, subject: int, other: int) -> tuple[list[float], int]:
    values, scenes = offsets().find(np.array([relation]), np.array([subject]), np.array([other]))
    return values[0].tolist(), int(scenes[0])


def test_a_pair_that_was_seen_has_its_own_offset() -> None:
    assert found(2, 1, 0) == (list(ON_IT), 12)
    assert found(0, 1, 0) == (list(BESIDE), 1)


def test_a_pair_never_seen_has_what_relation_and_classes_say_together() -> None:
    assert found(2, 2, 2) == ([0, 0, 0.5, 0.5, 0.5, 0.25], 0)
    assert found(2, 1, 2)[0] == pytest.approx([0, 0, 0.75, 0.5, 0.5, np.sqrt(0.03125)])
    assert found(2, 2, 0) == ([0, 0, 0.625, 0.25, 0.5, 0.25], 0)


def test_a_relation_that_no_scene_showed_means_nothing() -> None:
    assert found(1, 1, 0)[1] == found(3, 0, 2)[1] == -1


def test_without_a_pair_there_is_still_the_relation() -> None:
    nothing = np.zeros(0, np.int64)
    bare = offsets(pair=nothing, pair_offset=np.zeros((0, 6), "f4"), pair_scenes=nothing)
    values, scenes = bare.find(np.array([2]), np.array([2]), np.array([2]))
    assert (values[0].tolist(), scenes.tolist()) == ([0, 0, 0.5, 0.5, 0.5, 0.25], [0])
    assert Offsets.from_tensors(bare.tensors(), A, V).pair.shape == (0,)


def test_they_come_back_with_the_artifact(tmp_path: Path) -> None:
    artifact = written(tmp_path / "a")
    assert artifact.offsets is not None
    for name, tensor in offsets().tensors().items():
        assert np.array_equal(artifact.offsets.tensors()[name], tensor)
        assert name not in artifact.manifest.weights
    assert artifact.manifest.weights.keys() == state().keys()
    assert "| Offsets | in metres, of 2 pairs of classes |" in artifact.card


def test_an_artifact_may_have_none(tmp_path: Path) -> None:
    write_artifact(tmp_path / "a", description(), state())
    assert load_artifact(tmp_path / "a").offsets is None


@pytest.mark.parametrize(
    ("change", "code"),
    [
        ({"relation": np.zeros((A, 5), "f4")}, "wrong_shape"),
        ({"subject": np.zeros((A, V + 1, 6), "f4")}, "wrong_shape"),
        ({"pair_scenes": np.array([1], np.int32)}, "wrong_shape"),
        ({"pair": np.int64(3)}, "wrong_shape"),
        ({"pair": np.array([20, 3], np.int64)}, "invalid_tensor"),
        ({"pair": np.array([3, 3], np.int64)}, "invalid_tensor"),
        ({"pair": np.array([-1, 3], np.int64)}, "invalid_tensor"),
        ({"pair": np.array([3, -(2**63)], np.int64)}, "invalid_tensor"),
        ({"pair": np.array([3, A * V * V], np.int64)}, "invalid_tensor"),
        ({"pair": np.array([3.0, 21.0], "f4")}, "invalid_tensor"),
        ({"pair_scenes": np.array([0, 12], np.int32)}, "invalid_tensor"),
        ({"relation_scenes": np.array([-1, 0, 0, 0], np.int32)}, "invalid_tensor"),
        ({"pair_offset": np.zeros((2, 6), "f4")}, "invalid_tensor"),
        ({"relation": np.zeros((A, 6), "f4")}, "invalid_tensor"),
        ({"subject": np.full((A, V, 6), -1, "f4")}, "invalid_tensor"),
        ({"relation": np.full((A, 6), np.nan, "f4")}, "not_finite"),
    ],
)
def test_what_means_nothing_is_refused(tmp_path: Path, change: dict, code: str) -> None:
    with pytest.raises(ArtifactError) as refused:
        written(tmp_path / "a", **change)
    assert refused.value.code == code


def test_a_tensor_too_few_or_too_many_is_refused() -> None:
    tensors = offsets().tensors()
    with pytest.raises(ArtifactError) as refused:
        Offsets.from_tensors({**tensors, "offsets.more": np.zeros(2)}, A, V)
    assert "offsets.more" in refused.value.reason
    for name in tensors:
        with pytest.raises(ArtifactError):
            Offsets.from_tensors({n: t for n, t in tensors.items() if n != name}, A, V)
