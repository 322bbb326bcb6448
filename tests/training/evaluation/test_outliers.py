"""T3: who is added, by which law, and the metrics by hand."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from tests.training.evaluation.scenes import NO_STRUCTURE, V, scene, tensors, toy
from tests.training.test_objectives import toy_machine
from training.evaluation.missing import machine_score
from training.evaluation.outliers import (
    IntruderScores,
    by_popularity,
    by_room,
    draw_intruders,
    intruder_scores,
)


def test_intruders_are_found_where_scores_know_them():
    """A score that knows the clean scene ranks the intruder last; its opposite ranks it first."""
    data = tensors([scene([0, 1, 2]), scene([0, 1, 2])])
    known = lambda v: torch.tensor([5.0, 5, 5, -5, -5]).expand_as(v)  # noqa: E731
    scores = intruder_scores(data, NO_STRUCTURE, known)
    assert scores.hit_at_1().value == 1.0
    assert scores.auroc().value == 1.0
    assert scores.average_precision().value == 1.0
    wrong = intruder_scores(data, NO_STRUCTURE, lambda v: -known(v))
    assert wrong.hit_at_1().value == wrong.auroc().value == 0.0


def test_a_score_that_knows_nothing_is_at_chance():
    data = tensors([scene([0, 1, 2]) for _ in range(5)])
    scores = intruder_scores(data, NO_STRUCTURE, torch.zeros_like)
    assert scores.hit_at_1().value == pytest.approx(1 / 4)
    assert scores.auroc().value == pytest.approx(1 / 2)
    assert scores.average_precision().value == pytest.approx(
        # 5 true ones among 20 equal scores.
        sum((1 + (k - 1) * 4 / 19) / k for k in range(1, 21)) / 20
    )


def test_metrics_by_hand():
    """Two scenes of two objects and an intruder each; the second one is not found."""
    scores = IntruderScores(
        scene=np.array([0, 0, 0, 1, 1, 1, 0, 0, 1, 1]),
        log_odds=np.array([1.0, 2, -1, 0, 3, 1, 1, 2, 0, 3]),
        intruder=np.array([0, 0, 1, 0, 0, 1, 0, 0, 0, 0], dtype=np.bool_),
        size=np.array([3, 3, 3, 3, 3, 3, 2, 2, 2, 2]),
        clean=np.arange(10) >= 6,
        thing=np.array([0, 1, 2, 1, 2, 0, 0, 1, 1, 2]),
        scenes=3,
        skipped=1,
    )
    assert scores.hit_at_1().value == pytest.approx(1 / 2)
    # Intruders at -1 and 1, others at 1, 2, 0, 3: 4 pairs + 2.5 pairs of 8.
    assert scores.auroc().value == pytest.approx(6.5 / 8)
    suspicion = -scores.log_odds
    assert scores.false_alarms(suspicion >= 0.0).value == pytest.approx(1 / 2)
    assert scores.false_alarms(suspicion >= 0.5).value == 0.0
    assert scores.caught(suspicion >= 0.5).value == pytest.approx(1 / 2)
    # Class 0 is often an intruder: the second scene's is found, and the first one's still.
    likely = scores.with_prior(np.array([1.5, 0.0, 0.0]))
    assert likely.log_odds.tolist() == [-0.5, 2, -1, 0, 3, -0.5, -0.5, 2, 0, 3]
    assert likely.hit_at_1().value == 1.0


def test_intruders_are_absent_and_no_structure():
    structure = NO_STRUCTURE.clone()
    structure[4] = True
    data = tensors([scene([0, 1, 2]) for _ in range(20)])
    assert set(draw_intruders(data, structure).tolist()) == {3}
    small = tensors([scene([0, 1]), scene([0, 1, 4])])
    assert draw_intruders(small, structure).tolist() == [-1, -1]
    scores = intruder_scores(small, structure, torch.zeros_like)
    assert (len(scores.scene), scores.skipped) == (0, 2)


def test_popular_intruders_follow_training():
    """3 is in nine training scenes, 4 in three: three of four draws are 3.

    Of 400 draws, outside 250 to 350 with probability below 1e-7.
    """
    train = tensors([scene([0, 3])] * 6 + [scene([3, 4])] * 3)
    data = tensors([scene([0, 1, 2]) for _ in range(400)])
    added = draw_intruders(data, NO_STRUCTURE, by_popularity(data, train))
    assert set(added.tolist()) == {3, 4}
    assert 250 <= int((added == 3).sum()) <= 350


def test_intruders_of_the_same_room_type():
    train = tensors([scene([0, 3], room=0), scene([1, 4], room=1)])
    data = tensors([scene([0, 1, 2], room=0), scene([0, 1, 2], room=1), scene([0, 1, 2])])
    added = draw_intruders(data, NO_STRUCTURE, by_room(data, train))
    assert added.tolist() == [3, 4, -1]


def test_what_is_added_depends_on_the_scene_alone():
    scenes = [scene([0, 1], []), *(scene([0, 1, 2]) for _ in range(9))]
    together = draw_intruders(tensors(scenes), NO_STRUCTURE).tolist()
    assert together == [int(draw_intruders(tensors([s]), NO_STRUCTURE)[0]) for s in scenes]
    assert len(set(together[1:])) == 2


def test_an_object_is_judged_by_the_rest_without_itself():
    seen = []

    def spy(v):
        seen.append(v.clone())
        return torch.zeros_like(v)

    intruder_scores(tensors([scene([0, 1, 2])]), NO_STRUCTURE, spy)
    clean, dirty = seen
    assert clean.sum(1).tolist() == [2, 2, 2]
    assert dirty.sum(1).tolist() == [3, 3, 3, 3]


@pytest.mark.parametrize("name", ["rbm", "gbm", "triway-seed", "triway-local"])
def test_every_machine_can_be_evaluated(name):
    data = tensors([toy([0, 1, 2], [(0, 1, 2)]), toy([0, 3, 4], [(1, 3, 4)])])
    scores = intruder_scores(data, NO_STRUCTURE, machine_score(toy_machine(name)))
    assert scores.intruder.sum() == 2
    assert 0 <= scores.auroc().value <= 1
    assert scores.size.max() <= V
