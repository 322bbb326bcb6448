"""With and without evidence: what is told, what is asked, and that these never meet."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from app.scene import Scene
from tests.training.evaluation.furnished_rooms import STRUCTURE, VOCABULARY, room_model, rooms
from tests.training.evaluation.scenes import scene, tensors
from training.evaluation import evidence_tasks as evidence
from training.evaluation.asking import LeakError
from training.evaluation.evidence_tasks import (
    halves,
    intrusions,
    missing_evidence_task,
    outliers_evidence_task,
    reciprocal_rank,
    relations_evidence_task,
    removals,
)
from training.evaluation.setting import Setting

DATA = rooms(20, 3)
PLAIN = STRUCTURE.numpy()
TASKS = {
    "MRR": missing_evidence_task,
    "hit@1": outliers_evidence_task,
    "R-precision": relations_evidence_task,
}


def test_a_removed_class_is_nowhere():
    cases = list(removals(DATA, PLAIN))
    assert len(cases) > 20
    for case in cases:
        bare, more = case.scenes
        assert case.target not in {thing.class_index for thing in more.objects}
        assert bare == replace(more, room_type=None)
        assert more.room_type is not None
        assert more.relations is None


@pytest.mark.parametrize("kind", ["relations", "poses"])
def test_no_asked_pair_is_told(kind):
    cases = list(halves(DATA, PLAIN, kind))
    assert cases
    for case in cases:
        _, more = case.scenes
        for a, i, j in more.relations:
            assert not case.queried[a, i, j]
        if more.poses is not None:
            assert not (more.poses.observed & case.queried).any()
        assert not (case.truth & ~case.queried).any()
        own = DATA.scenes[case.scene_index].instance_classes
        assert not case.queried[:, PLAIN[own]].any()


def test_an_intruder_is_the_last_object_of_both_scenes():
    intruders = np.array(
        [np.flatnonzero((one == 0) & ~PLAIN)[0] for one in DATA.v.numpy()], dtype=np.int64
    )
    intruders[0] = -1
    cases = list(intrusions(room_model(), DATA, PLAIN, intruders))
    assert {case.scene_index for case in cases} == set(range(1, len(DATA)))
    for case in cases:
        bare, more = case.scenes
        assert bare == replace(more, room_type=None)
        assert case.target == len(more.objects) - 1
        assert more.objects[-1].class_index == intruders[case.scene_index]


def test_reciprocal_ranks_by_hand(monkeypatch):
    p = np.array([0.1, 0.4, 0.4, -np.inf, 0.4])
    monkeypatch.setattr(evidence, "missing_probabilities", lambda *_: p)
    assert reciprocal_rank(None, Scene(()), 0) == pytest.approx(1 / 4)
    assert reciprocal_rank(None, Scene(()), 2) == pytest.approx((1 + 1 / 2 + 1 / 3) / 3)


@pytest.mark.parametrize("metric", TASKS)
def test_a_change_is_the_difference_of_both_sides(metric):
    outcome = TASKS[metric](room_model(), Setting(DATA, STRUCTURE, limit=8))
    kinds = evidence.OF_RELATIONS if metric == "R-precision" else evidence.OF_OBJECTS
    for kind in kinds:
        names = (f"change of {metric}, {kind}", f"{metric}, {kind}", f"{metric}, {kind} withheld")
        change, given, without = (outcome.metrics[name] for name in names)
        assert change.value == pytest.approx(given.value - without.value)
        assert 0 <= without.value <= 1
        np.testing.assert_array_equal(change.groups, without.groups)
    assert next(iter(outcome.metrics)) == f"change of {metric}, {kinds[0]}"


@pytest.mark.parametrize("metric", TASKS)
def test_scenes_without_evidence_ask_nothing(metric):
    silent = tensors([scene([0, 1, 2]) for _ in range(3)], len(VOCABULARY))
    assert TASKS[metric](room_model(), Setting(silent, STRUCTURE)) is None


def test_a_source_without_positions_has_no_poses():
    flat = [replace(one, instance_positions=None) for one in DATA.scenes]
    data = replace(DATA, scenes=flat)
    outcome = relations_evidence_task(room_model(), Setting(data, STRUCTURE, limit=5))
    assert {name.split(", ")[1].split()[0] for name in outcome.metrics} == {"relations"}


def test_a_planted_cheater_is_caught(monkeypatch):
    """A model that counts the questions, and so knows what was removed."""
    targets = iter([case.target for case in removals(DATA, PLAIN) for _ in "ab"] * 3)
    cheat = lambda *_: np.eye(len(VOCABULARY))[next(targets)]  # noqa: E731
    monkeypatch.setattr(evidence, "missing_probabilities", cheat)
    with pytest.raises(LeakError, match="leaks information"):
        missing_evidence_task(room_model(), Setting(DATA, STRUCTURE, limit=None))
