"""Counts of places in an artifact, and what they tell about a place."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from app.registry import Artifact, ArtifactError, Places, load_artifact, write_artifact
from app.scene.roles import role_counts
from tests.registry.small_artifacts import description, refused, state

A, V = 5, 3  # as in `small_artifacts`
LEFT, FRONT, ON_TOP = 0, 1, 2
HELD = {(LEFT, 0, 1): 4.0, (ON_TOP, 1, 0): 9.0, (ON_TOP, 1, 2): 2.0, (ON_TOP, 2, 0): 1.0}
FREQUENCY = (0.5, 0.3, 0.1)


def places(**changes: np.ndarray) -> Places:
    """A lamp (1) on a bed (0) in nine scenes, and three other triples."""
    arrays = {
        "triple": np.array([(a * V + i) * V + j for a, i, j in HELD], np.int32),
        "held": np.array([*HELD.values()], np.float32),
        "frequency": np.array(FREQUENCY, np.float32),
        "role_pair": np.array([1 * V + 0, 2 * V + 0], np.int32),
        "role_counts": np.array([(7, 1, 0), (0, 3, 0)], np.float32),
        "role_anchor": np.array([(7, 4, 0), (0, 0, 0), (0, 0, 0)], np.float32),
        "stands": np.array([(1, 0, 0), (0.25, 0.25, 0.5), (0.5, 0.5, 0)], np.float32),
    }
    return Places(**(arrays | changes))


def written(directory: Path, table: Places) -> Artifact:
    write_artifact(directory, description(), state() | table.tensors(), storage_dtype="float16")
    return load_artifact(directory)


def test_they_come_back_with_the_artifact(tmp_path: Path) -> None:
    artifact = written(tmp_path / "a", places())
    assert artifact.places is not None
    assert artifact.offsets is artifact.counts is None
    for name, tensor in places().tensors().items():
        assert np.array_equal(artifact.places.tensors()[name], tensor)
    assert artifact.manifest.weights.keys() == state().keys()
    assert role_counts(artifact.places.roles, 1, 0).tolist() == [7, 1, 0]
    assert role_counts(artifact.places.roles, 0, 1).tolist() == [0, 0, 0]


@pytest.mark.parametrize(
    ("change", "code"),
    [
        ({"held": np.zeros(3, "f4")}, "wrong_shape"),
        ({"frequency": np.ones(2, "f4")}, "wrong_shape"),
        ({"role_counts": np.zeros((2, 2), "f4")}, "wrong_shape"),
        ({"role_anchor": np.zeros((2, 3), "f4")}, "wrong_shape"),
        ({"stands": np.zeros((V, 2), "f4")}, "wrong_shape"),
        ({"triple": np.int32(3)}, "wrong_shape"),
        ({"triple": np.array([1, 2, 3, 4], "f4")}, "invalid_tensor"),
        ({"triple": np.array([1, 3, 2, 4], "i4")}, "invalid_tensor"),
        ({"triple": np.array([1, 2, 2, 4], "i4")}, "invalid_tensor"),
        ({"triple": np.array([-1, 2, 3, 4], "i4")}, "invalid_tensor"),
        ({"triple": np.array([1, 2, 3, A * V * V], "i4")}, "invalid_tensor"),
        ({"triple": np.zeros(0, "i4"), "held": np.zeros(0, "f4")}, "invalid_tensor"),
        ({"role_pair": np.array([2, V * V], "i4")}, "invalid_tensor"),
        ({"role_pair": np.array([2, 1], "i4")}, "invalid_tensor"),
        ({"role_pair": np.array([1, 2], "f4")}, "invalid_tensor"),
        ({"held": np.float32([4, -1, 1, 2])}, "invalid_tensor"),
        ({"frequency": np.float32([0.5, 0, 0.1])}, "invalid_tensor"),
        ({"role_counts": np.float32([(7, 1, 0), (0, -3, 0)])}, "invalid_tensor"),
        ({"role_anchor": np.full((V, 3), -1, "f4")}, "invalid_tensor"),
        ({"stands": np.full((V, 3), -1, "f4")}, "invalid_tensor"),
        ({"stands": np.full((V, 3), np.nan, "f4")}, "not_finite"),
    ],
)
def test_invalid_tensors_are_refused(tmp_path: Path, change: dict, code: str) -> None:
    with refused(code):
        written(tmp_path / "a", places(**change))


def test_a_tensor_too_few_or_too_many_is_refused() -> None:
    tensors = places().tensors()
    with pytest.raises(ArtifactError):
        Places.from_tensors({**tensors, "places.more": np.zeros(2)}, A, V)
    for name in tensors:
        with pytest.raises(ArtifactError):
            Places.from_tensors({n: t for n, t in tensors.items() if n != name}, A, V)


@pytest.mark.parametrize("relation", range(A))
@pytest.mark.parametrize("anchor", range(V))
@pytest.mark.parametrize("outgoing", [True, False])
def test_the_ratio_of_a_place_is_that_of_smoothed_counts(
    relation: int, anchor: int, outgoing: bool
) -> None:
    """Also for a relation that no scene shows: the place then tells nothing."""

    def held(a: int, i: int, j: int) -> float:
        return HELD.get((a, i, j) if outgoing else (a, j, i), 0.0)

    ratio = places().log_ratio(relation, anchor, outgoing=outgoing)
    of_relation = sum(held(relation, i, j) for i in range(V) for j in range(V))
    at_anchor = sum(held(relation, i, anchor) for i in range(V))
    for i in range(V):
        of_class = sum(held(relation, i, j) for j in range(V))
        back_off = (of_class + 3 * FREQUENCY[i] / sum(FREQUENCY)) / (of_relation + 3)
        p = (held(relation, i, anchor) + 10 * back_off) / (at_anchor + 10)
        assert ratio[i] == pytest.approx(np.log(p / FREQUENCY[i]), abs=1e-5)


def test_two_scenes_show_a_relation() -> None:
    for a in range(A):
        shown = places().shows(a, np.arange(V), np.arange(V))
        expected = [[HELD.get((a, i, j), 0) >= 2 for j in range(V)] for i in range(V)]
        assert shown.tolist() == expected


def test_supporters_are_smoothed_counts_of_on_top_and_inside() -> None:
    """A lamp (1) is on a bed (0) and on class 2, and class 2 is in a bed."""
    table = places(
        triple=np.array([(2 * V + 1) * V, (2 * V + 1) * V + 2, (4 * V + 2) * V], np.int32),
        held=np.array([9, 2, 1], np.float32),
    )
    prior = np.array([10.5, 0.5, 2.5]) / 13.5
    held = np.array([(0, 0, 0), (9, 0, 2), (1, 0, 0)])
    expected = (held + 10 * prior) / (held.sum(1, keepdims=True) + 10)
    assert table.supporters(np.arange(V), np.arange(V)) == pytest.approx(expected)
    assert table.supporters(np.array([1]), np.array([2])) == pytest.approx(expected[1:2, 2:])


def test_the_roles_tell_under_from_on() -> None:
    """Class 2 is under class 0 in three scenes; class 1 is on it in seven and under it in one."""
    assert places().under_evidence(0, 2) == pytest.approx(np.log(9 / 0.5))
    assert places().under_evidence(0, 1) == pytest.approx(np.log(1 / 7.5))
    assert places().under_evidence(1, 0) == -np.inf
    assert places().means_under(0, 2)
    assert not places().means_under(0, 1)  # one scene may be an error
    assert not places().means_under(2, 0)
