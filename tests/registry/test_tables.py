"""Tables of statistics in an artifact: they are stored, checked, and looked up."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from app.model import Counts, Offsets, Places, Possibility
from app.model.fields import TensorGroup
from app.registry import Artifact, ArtifactError, load_artifact, write_artifact
from app.registry.manifest import of_machine
from app.registry.tensors import read_group
from app.scene.roles import role_counts
from tests.registry.small_artifacts import description, refused, state

A, V, C, M = 5, 3, 2, 4  # A, V and C as in `small_artifacts`
LEFT, FRONT, ON_TOP = 0, 1, 2
BESIDE, ON_IT = (0, 1, 0.5, 0.5, 0.5, 0.25), (0, 0, 0.75, 0.5, 0.25, 0.125)
HELD = {(LEFT, 0, 1): 4.0, (ON_TOP, 1, 0): 9.0, (ON_TOP, 1, 2): 2.0, (ON_TOP, 2, 0): 1.0}
FREQUENCY = (0.5, 0.3, 0.1)
CLASSES = np.arange(V)


def counts(**changes: Any) -> Counts:
    weights = np.full((2, 2, 3 + C + V), 0.25, np.float32)
    weights[0, :, 3 + C] = weights[1, :, 4 + C] = 0
    values = {
        "classes": np.array([0, 1]),
        "most": np.array([1, M - 1]),
        "log_share": np.full((2, M), -1.5, np.float32),
        "weights": weights,
    }
    return Counts(**(values | changes))


def offsets(**changes: Any) -> Offsets:
    """Offsets of a lamp (1) on a bed (0) in 12 scenes, and of a lamp beside it in one."""
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


def places(**changes: Any) -> Places:
    """Places of a lamp (1) on a bed (0) in nine scenes, and of three other triples."""
    values = {
        "triple": np.array([(a * V + i) * V + j for a, i, j in HELD], np.int32),
        "triple_scenes": np.array([*HELD.values()], np.float32),
        "frequency": np.array(FREQUENCY, np.float32),
        "role_pair": np.array([1 * V + 0, 2 * V + 0], np.int32),
        "role_counts": np.array([(7, 1, 0), (0, 3, 0)], np.float32),
        "role_anchor": np.array([(7, 4, 0), (0, 0, 0), (0, 0, 0)], np.float32),
        "stands": np.array([(1, 0, 0), (0.25, 0.25, 0.5), (0.5, 0.5, 0)], np.float32),
        "within": np.array([0.75, 0.125, 0], np.float32),
    }
    return Places(**(values | changes))


def possibility(**changes: Any) -> Possibility:
    """Descriptions of two classes, and none of the third one."""
    values = {
        "stands": np.array(
            [(1, 0, 0, 0, 0), (0.25, 0, 0.25, 0.5, 0), (0.25, 0.25, 0.25, 0.125, 0.125)], np.float32
        ),
        "traits": np.array([(1, 0, 3), (0, 0.5, 1), (-1, -1, -1)], np.float32),
        "spread": np.array([0.25, 0.5, 0.25], np.float32),
        "weights": np.arange(16, dtype=np.float32).reshape(4, 4) / 8,
    }
    return Possibility(**(values | changes))


GROUPS: tuple[Any, ...] = (counts, offsets, places, possibility)


def written(directory: Path, group: TensorGroup) -> Artifact:
    tensors = state() | group.tensors()
    write_artifact(directory, description(), tensors, storage_dtype="float16")
    return load_artifact(directory)


NAMES = [group.__name__ for group in GROUPS]


@pytest.mark.parametrize("group", GROUPS)
def test_a_group_comes_back_with_the_artifact(tmp_path: Path, group: Any) -> None:
    artifact = written(tmp_path / "a", group())
    groups = {name: getattr(artifact.model, name) for name in NAMES}
    loaded = groups.pop(group.__name__)
    assert [*groups.values()] == [None] * 3
    for name, tensor in group().tensors().items():
        assert np.array_equal(loaded.tensors()[name], tensor)
    assert of_machine(artifact.manifest.tensors).keys() == state().keys()
    lines = {
        counts: "| Counts | of instances, for 2 classes |",
        offsets: "| Offsets | in metres, of 2 pairs of classes |",
    }
    assert lines.get(group, "") in artifact.card


def full(value: float, *shape: int) -> Any:
    return np.full(shape, value, "f4")


def with_zero(array: Any) -> Any:
    """A copy whose first variance or standard deviation is 0."""
    array = array.copy()
    array[0, 3] = 0
    return array


EMPTY = np.zeros(0, "i4")
NO_CLASS = {"classes": EMPTY, "most": EMPTY, "log_share": full(-1, 0, M)}
INVALID: dict[tuple[Any, str], list[dict[str, Any]]] = {
    (counts, "wrong_shape"): [{"weights": full(0, 2, 2, 2 + C + V)}],
    (counts, "invalid_tensor"): [
        *({"classes": np.array(c)} for c in ([1, 0], [0, 0], [-1, 1], [0, V], [0, -(2**63)])),
        NO_CLASS | {"weights": full(0, 0, 2, 3 + C + V)},
        *({"most": np.array(most)} for most in ([0, 1], [1, M])),
        *({"log_share": full(-1, 2, columns)} for columns in (1, 300)),
        *({"log_share": full(value, 2, M)} for value in (0.5, -1e4)),
        {"weights": counts().weights * 1e5},
        {"weights": full(0.5, 2, 2, 3 + C + V)},  # of a class on itself
    ],
    (counts, "not_finite"): [{"weights": full(np.nan, 2, 2, 3 + C + V)}],
    (offsets, "wrong_shape"): [{"relation": full(0, A, 5)}, {"pair": np.int64(3)}],
    (offsets, "invalid_tensor"): [
        *({"pair": np.array([3, key])} for key in (2, 3, -(2**63), A * V * V)),
        {"pair": np.array([-1, 3])},
        {"pair_scenes": np.array([0, 12], "i4")},
        {"relation_scenes": np.array([-1, 0, 0, 0, 0], "i4")},
        {"pair_offset": with_zero(offsets().pair_offset)},
        {"relation": with_zero(offsets().relation), "relation_scenes": np.array([1, 0, 9, 0, 0])},
        {"relation": full(0, A, 6)},
    ],
    (offsets, "not_finite"): [{"relation": full(np.nan, A, 6)}],
    (places, "wrong_shape"): [
        *({"triple_scenes": full(0, 3)}, {"frequency": full(1, 2)}, {"role_counts": full(0, 2, 2)}),
        *({"role_anchor": full(0, 2, 3)}, {"stands": full(0, V, 2)}, {"within": full(0, V, 1)}),
    ],
    (places, "invalid_tensor"): [
        *({"triple": np.array([1, *keys, 4], "i4")} for keys in ((3, 2), (2, 2))),
        *({"triple": np.array([key, 2, 3, last], "i4")} for key, last in ((-1, 4), (1, A * V * V))),
        {"triple": EMPTY, "triple_scenes": full(0, 0)},
        *({"role_pair": np.array([2, key], "i4")} for key in (V * V, 1)),
        {"triple_scenes": np.array([4, -1, 1, 2], "f4")},
        {"frequency": np.array([0.5, 0, 0.1], "f4")},
        {"role_counts": np.array([(7, 1, 0), (0, -3, 0)], "f4")},
        *({name: full(-1, V, 3)} for name in ("role_anchor", "stands")),
        {"within": full(-1, V)},
    ],
    (places, "not_finite"): [{"stands": full(np.nan, V, 3)}, {"within": full(np.inf, V)}],
    (possibility, "wrong_shape"): [
        *({"stands": full(0, V, 3)}, {"traits": full(0, 2, 3)}, {"weights": full(0, 4, 3)}),
        *({"spread": full(1, V, 1)}, {"weights": full(0, 3, 4)}),
    ],
    (possibility, "invalid_tensor"): [
        {"stands": full(-0.5, V, 5)},
        {"traits": full(-2, V, 3)},
        *({"spread": full(value, V)} for value in (0, -1)),
        {"weights": full(-0.5, 4, 4)},  # no feature makes a place more possible
    ],
    (possibility, "not_finite"): [{"weights": full(np.nan, 4, 4)}],
}


@pytest.mark.parametrize(
    ("group", "code", "change"), [(*key, c) for key, changes in INVALID.items() for c in changes]
)
def test_invalid_tensors_are_refused(tmp_path, group, code, change):
    with refused(code):
        written(tmp_path / "a", group(**change))


@pytest.mark.parametrize("group", GROUPS)
def test_missing_and_unexpected_tensors_are_refused(group: Any) -> None:
    tensors, more = group().tensors(), f"{group.__name__}.more"
    with pytest.raises(ArtifactError, match=more):
        read_group(type(group()), {**tensors, more: np.zeros(2)}, A, V, C)
    for name in tensors:
        with pytest.raises(ArtifactError):
            read_group(type(group()), {n: t for n, t in tensors.items() if n != name}, A, V, C)


def test_counts_at_their_limits_are_accepted() -> None:
    share, weights = np.array([(0, -64)] * 2, "f4"), counts().weights * 256
    at_limits = counts(most=np.array([1, 1]), log_share=share, weights=weights)
    assert read_group(Counts, at_limits.tensors(), A, V, C).weights.max() == 64


@pytest.mark.parametrize(
    ("triple", "offset", "scenes"),
    [
        ((2, 1, 0), ON_IT, 12),
        ((0, 1, 0), BESIDE, 1),
        # A pair without scenes has the sum of the terms of the relation and of both classes.
        ((2, 2, 2), (0, 0, 0.5, 0.5, 0.5, 0.25), 0),
        ((2, 1, 2), (0, 0, 0.75, 0.5, 0.5, np.sqrt(0.03125)), 0),
        ((2, 2, 0), (0, 0, 0.625, 0.25, 0.5, 0.25), 0),
        # Without scenes of the relation, the offset has no meaning.
        ((1, 1, 0), None, -1),
        ((3, 0, 2), None, -1),
    ],
)
def test_offsets_are_those_of_the_pair_or_of_the_relation(triple, offset, scenes):
    values, numbers = offsets().find(*(np.array([index]) for index in triple))
    assert numbers.tolist() == [scenes]
    assert offset is None or values[0].tolist() == pytest.approx(offset)


@pytest.mark.parametrize("relation", range(A))
@pytest.mark.parametrize("anchor", range(V))
@pytest.mark.parametrize("outgoing", [True, False])
def test_the_ratio_of_a_place_is_that_of_smoothed_counts(relation, anchor, outgoing):
    """Also for a relation without scenes: the place then changes nothing."""

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


def test_the_scenes_of_a_relation_are_those_of_its_triple() -> None:
    expected = [[[HELD.get((a, i, j), 0) for j in CLASSES] for i in CLASSES] for a in range(A)]
    assert places().scenes(range(A), CLASSES, CLASSES).tolist() == expected
    assert places().scenes([ON_TOP], np.array([1]), np.array([2, 0])).tolist() == [[[2, 9]]]


def test_supporters_are_smoothed_counts_of_on_top_and_inside() -> None:
    """A lamp (1) is on a bed (0) and on class 2, and class 2 is in a bed."""
    table = places(
        triple=np.array([(2 * V + 1) * V, (2 * V + 1) * V + 2, (4 * V + 2) * V], np.int32),
        triple_scenes=np.array([9, 2, 1], np.float32),
    )
    prior = np.array([10.5, 0.5, 2.5]) / 13.5
    held = np.array([(0, 0, 0), (9, 0, 2), (1, 0, 0)])
    expected = (held + 10 * prior) / (held.sum(1, keepdims=True) + 10)
    assert table.supporters(CLASSES, CLASSES) == pytest.approx(expected)
    assert table.supporters(np.array([1]), np.array([2])) == pytest.approx(expected[1:2, 2:])
    assert table.any_supporters(np.array([2, 0])) == pytest.approx(prior[[2, 0]])


def test_the_roles_tell_under_from_on() -> None:
    """Class 2 is under class 0 in three scenes; class 1 is on it in seven and under it in one."""
    table = places()
    assert role_counts(table.roles, 1, 0).tolist() == [7, 1, 0]
    assert role_counts(table.roles, 0, 1).tolist() == [0, 0, 0]
    assert table.under_evidence(0, 2) == pytest.approx(np.log(9 / 0.5))
    assert table.under_evidence(0, 1) == pytest.approx(np.log(1 / 7.5))
    assert table.under_evidence(1, 0) == -np.inf
    assert table.means_under(0, 2)
    assert not table.means_under(0, 1)  # one scene may be an error
    assert not table.means_under(2, 0)
    # "Class 0 on top of class 2" is never said in these words, and "1 on top of 0" always.
    assert table.literal_share(0, 2) == pytest.approx(0.5 / 3.5)
    assert table.literal_share(1, 0) == 1
    assert table.literal_share(0, 1) == pytest.approx(0.5 / 1.5)
    # Two scenes suffice, unless as many show the upper class on the lower.
    two, pairs = np.array([(2, 0, 0), (7, 1, 0), (0, 2, 0)], "f4"), np.array([2, 3, 6], "i4")
    assert places(role_counts=two[1:], role_pair=pairs[1:]).means_under(0, 2)
    assert not places(role_counts=two, role_pair=pairs).means_under(0, 2)
