"""T2 by hand, and that nothing of the removed object can leak."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from tests.training.evaluation.scenes import (
    NO_STRUCTURE,
    WIDE,
    WIDE_STRUCTURE,
    scene,
    tensors,
    toy,
)
from tests.training.test_objectives import toy_machine
from training.evaluation.missing import (
    LeakError,
    leave_one_out,
    leave_one_out_in_rooms,
    machine_score,
    missing_metrics,
)


def test_reciprocal_ranks_by_hand():
    """Scores fixed as 5, 4, 3, 2, 1: removing 2 from {0, 2} leaves 1 above it, and so on."""
    fixed = torch.tensor([5.0, 4, 3, 2, 1])
    result = leave_one_out(tensors([scene([0, 2])]), NO_STRUCTURE, lambda v: fixed.expand_as(v))
    assert dict(zip(result.target.tolist(), result.above.tolist(), strict=True)) == {0: 0, 2: 1}
    metrics = missing_metrics(result)
    assert metrics["MRR"].value == pytest.approx((1 + 1 / 2) / 2)
    assert metrics["top-1"].value == pytest.approx(0.5)
    assert metrics["MRR"].n == 2


def test_macro_counts_every_class_alike():
    """Class 0 is found in three scenes, class 2 comes second in all, class 4 last of two."""
    fixed = torch.tensor([5.0, 4, 3, 2, 1])
    data = tensors([scene([0, 2]), scene([0, 2]), scene([0, 2, 4])])
    result = leave_one_out(data, NO_STRUCTURE, lambda v: fixed.expand_as(v))
    metrics = missing_metrics(result)
    assert metrics["MRR"].value == pytest.approx((3 * 1 + 3 / 2 + 1 / 3) / 7)
    assert metrics["MRR, macro by class"].value == pytest.approx((1 + 1 / 2 + 1 / 3) / 3)


def test_ties_score_their_expectation_under_random_order():
    """All equal, 4 candidates: the rank is uniform on 1..4."""
    flat = lambda v: torch.zeros_like(v)  # noqa: E731
    result = leave_one_out(tensors([scene([0, 2])]), NO_STRUCTURE, flat)
    expected = (1 + 1 / 2 + 1 / 3 + 1 / 4) / 4
    assert result.reciprocal_rank() == pytest.approx([expected] * 2)
    assert result.top(1) == pytest.approx([1 / 4] * 2)
    assert result.top(5) == pytest.approx([1.0] * 2)


def test_structure_is_neither_removed_nor_a_candidate():
    structure = NO_STRUCTURE.clone()
    structure[1] = True
    flat = lambda v: torch.tensor([0.0, 9, 0, 0, 0]).expand_as(v)  # noqa: E731
    result = leave_one_out(tensors([scene([0, 1, 2])]), structure, flat)
    assert sorted(result.target.tolist()) == [0, 2]
    assert result.above.tolist() == [0, 0]


def test_small_scenes_are_skipped_and_counted():
    result = leave_one_out(tensors([scene([0]), scene([0, 1])]), NO_STRUCTURE, lambda v: v)
    assert result.skipped == 1
    assert result.scenes == 2


def test_the_removed_object_cannot_leak():
    """What is scored never sees the target: the score of a scene with it equals that without."""
    seen = []

    def spy(v):
        seen.append(v.clone())
        return torch.zeros_like(v)

    leave_one_out(tensors([scene([0, 1, 2], [(0, 0, 1)])]), NO_STRUCTURE, spy)
    shown, shown_again = seen
    assert sorted(shown_again.tolist()) == sorted(shown.tolist())
    assert shown.tolist() == [[0, 1, 1, 0, 0], [1, 0, 1, 0, 0], [1, 1, 0, 0, 0]]


def turns(data, hint):
    """What a cheater answers who knows whose turn it is: a hint for each removed object in turn."""
    hints = []
    for entry in data.scenes:
        for x, target in enumerate(entry.evidence.classes.tolist()):
            row = torch.zeros(data.v.shape[1])
            for told in hint(entry.evidence, x, target):
                row[told] = 1.0
            hints.append(row)
    return iter(hints * 3)


CHEATERS = {
    "its relations dangle": lambda evidence, x, target: (
        [target] if evidence.holds[:, x].any() or evidence.holds[:, :, x].any() else []
    ),
    "the whole scene": lambda evidence, x, target: evidence.classes.tolist(),
    "the removed object": lambda evidence, x, target: [target],
}


@pytest.mark.parametrize("cheater", CHEATERS)
@pytest.mark.parametrize("first", [3, 9])
def test_a_planted_cheater_is_caught(cheater, first):
    """However many objects the first scene has: rows of all scenes are asked for again."""
    large = scene(range(first), [(0, 0, 1), (1, 1, 2)])
    data = tensors([large, scene([1, 3, 4], [(2, 1, 4)]), scene([0, 10])], WIDE)
    answers = turns(data, CHEATERS[cheater])

    def cheat(v):
        return torch.stack([next(answers) for _ in v])

    with pytest.raises(LeakError, match="something leaks"):
        leave_one_out(data, WIDE_STRUCTURE, cheat)


def test_unknown_labels_score_zero():
    result = leave_one_out(
        tensors([scene([0, 2]), scene([1])]), NO_STRUCTURE, lambda v: torch.zeros_like(v)
    )
    known = missing_metrics(result)["MRR"].value
    # The second scene is skipped, whatever else it holds.
    assert result.with_unknown(np.array([2, 5])).value == pytest.approx(known / 2)


def test_a_score_that_is_no_number_is_an_error():
    with pytest.raises(FloatingPointError, match="not a number"):
        leave_one_out(tensors([scene([0, 2])]), NO_STRUCTURE, lambda v: v * float("nan"))


@pytest.mark.parametrize("name", ["rbm", "gbm", "triway-seed", "triway-local"])
def test_every_machine_can_be_evaluated(name):
    data = tensors([toy([0, 1, 2], [(0, 1, 2)]), toy([0, 3, 4], [(1, 3, 4)])])
    result = leave_one_out(data, NO_STRUCTURE, machine_score(toy_machine(name)))
    assert np.isfinite(result.log_probability).all()


def test_the_room_type_of_the_scene_is_told():
    """A score that knows what belongs to each room finds it there alone."""
    told = []

    def score(v, room):
        told.extend(room.tolist())
        return torch.eye(5)[room + 1]

    data = tensors([scene([0, 1, 2], room=0), scene([0, 1, 2], room=1)])
    result = leave_one_out_in_rooms(data, NO_STRUCTURE, score)
    assert told[:6] == [0, 0, 0, 1, 1, 1]
    found = {
        (int(data.room[row]), int(target)): int(above)
        for row, target, above in zip(result.scene, result.target, result.above, strict=True)
    }
    assert (found[0, 1], found[1, 2]) == (0, 0)
    assert result.ties[0] > 0
