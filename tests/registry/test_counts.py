"""Counts in an artifact: they come back as written, and invalid tensors are refused."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from app.registry import Artifact, ArtifactError, Counts, load_artifact, write_artifact
from tests.registry.small_artifacts import description, state

V, C, M = 3, 2, 4  # V and C as in `small_artifacts`


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


def written(directory: Path, **changes: np.ndarray) -> Artifact:
    tensors = state() | counts(**changes).tensors()
    write_artifact(directory, description(), tensors, storage_dtype="float16")
    return load_artifact(directory)


def test_they_come_back_with_the_artifact(tmp_path: Path) -> None:
    artifact = written(tmp_path / "a")
    assert artifact.counts is not None
    for name, tensor in counts().tensors().items():
        assert np.array_equal(artifact.counts.tensors()[name], tensor)
    assert artifact.manifest.weights.keys() == state().keys()
    assert "| Counts | of instances, for 2 classes |" in artifact.card


@pytest.mark.parametrize(
    ("change", "code"),
    [
        ({"weights": np.zeros((2, 2, 2 + C + V), "f4")}, "wrong_shape"),
        ({"weights": np.zeros((3, 2, 3 + C + V), "f4")}, "wrong_shape"),
        ({"weights": np.zeros((2, 3 + C + V), "f4")}, "wrong_shape"),
        ({"most": np.array([1])}, "wrong_shape"),
        ({"log_share": np.float32(-1)}, "wrong_shape"),
        ({"log_share": np.full((1, M), -1, "f4")}, "wrong_shape"),
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
    ],
)
def test_invalid_counts_are_refused(tmp_path: Path, change: dict, code: str) -> None:
    with pytest.raises(ArtifactError) as refused:
        written(tmp_path / "a", **change)
    assert refused.value.code == code


def test_a_tensor_too_few_or_too_many_is_refused() -> None:
    tensors = counts().tensors()
    with pytest.raises(ArtifactError) as refused:
        Counts.from_tensors({**tensors, "counts.more": np.zeros(2)}, V, C)
    assert "counts.more" in refused.value.reason
    for name in tensors:
        with pytest.raises(ArtifactError):
            Counts.from_tensors({n: t for n, t in tensors.items() if n != name}, V, C)
