"""With and without evidence: what is told, what is asked, and that these never meet."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from app.scene import Scene
from tests.training.evaluation.furnished_rooms import STRUCTURE, VOCABULARY, room_model, rooms
from tests.training.evaluation.scenes import scene, tensors
from training.evaluation import evidence_tasks as evidence
from training.evaluation.evidence_tasks import (
    halves,
    missing_evidence_task,
    reciprocal_rank,
    relations_evidence_task,
    removals,
)
from training.evaluation.setting import Setting

DATA = rooms(20, 3)
PLAIN = STRUCTURE.numpy()
TASKS = {"MRR": missing_evidence_task, "R-precision": relations_evidence_task}


def test_a_removed_class_is_nowhere():
    cases = list(removals(DATA, PLAIN))
    assert len(cases) > 20
    for case in cases:
        assert case.asked not in {thing.class_index for thing in case.scene.objects}
        assert case.scene.room_type is not None
        assert case.scene.relations is None


@pytest.mark.parametrize("kind", ["relations", "poses"])
def test_no_asked_pair_is_told(kind):
    cases = list(halves(DATA, PLAIN, kind))
    assert cases
    for case in cases:
        queried, truth = case.asked
        for a, i, j in case.scene.relations:
            assert not queried[a, i, j]
        if kind == "poses":
            assert not (case.scene.poses.observed & queried).any()
        assert not (truth & ~queried).any()
        own = DATA.scenes[case.scene_index].instance_classes
        assert not queried[:, PLAIN[own]].any()


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
    assert next(iter(outcome.metrics)) == f"change of {metric}, {kinds[0]}"
    silent = tensors([scene([0, 1, 2]) for _ in range(3)], len(VOCABULARY))
    assert TASKS[metric](room_model(), Setting(silent, STRUCTURE)) is None


def test_a_source_without_positions_has_no_poses():
    flat = [replace(one, instance_positions=None) for one in DATA.scenes]
    data = replace(DATA, scenes=flat)
    outcome = relations_evidence_task(room_model(), Setting(data, STRUCTURE, limit=5))
    assert {name.split(", ")[1].split()[0] for name in outcome.metrics} == {"relations"}
