from dataclasses import replace

import pytest

from tests.training.evaluation.furnished_rooms import STRUCTURE, VOCABULARY, room_model, rooms
from tests.training.evaluation.scenes import scene, tensors
from training.evaluation.object_tasks import OF_OBJECTS, missing_evidence_task
from training.evaluation.relation_tasks import (
    OF_RELATIONS,
    evidence_cases,
    relations_evidence_task,
)
from training.evaluation.setting import Setting

DATA = rooms(20, 3)
PLAIN = STRUCTURE.numpy()
TASKS = {"MRR": missing_evidence_task, "R-precision": relations_evidence_task}


@pytest.mark.parametrize("kind", ["relations", "poses"])
def test_evidence_contains_no_queried_relation(kind):
    cases = list(evidence_cases(DATA, PLAIN, kind))
    assert cases
    for case in cases:
        for a, i, j in case.scene.triples:
            assert not case.queried[a, i, j]
        if kind == "poses":
            _, observed = case.scene.relations.grids(len(case.scene.objects))
            assert not (observed & case.queried).any()
        assert not (case.truth & ~case.queried).any()
        assert not case.queried[:, PLAIN[DATA.scenes[case.scene_index].instance_classes]].any()


@pytest.mark.parametrize("metric", TASKS)
def test_a_change_is_the_difference_of_both_sides(metric):
    outcome = TASKS[metric](room_model(), Setting(DATA, STRUCTURE, limit=8))
    kinds = OF_RELATIONS if metric == "R-precision" else OF_OBJECTS
    for kind in kinds:
        names = (f"change of {metric}, {kind}", f"{metric}, {kind}", f"{metric}, {kind} withheld")
        change, given, without = (outcome.metrics[name] for name in names)
        assert change.value == pytest.approx(given.value - without.value)
        assert 0 <= without.value <= 1
    assert next(iter(outcome.metrics)) == f"change of {metric}, {kinds[0]}"
    # Stated relations do not change answers of a model without implications.
    assert metric != "MRR" or outcome.metrics["change of MRR, room type"].numerators.any()
    silent = tensors([scene([0, 1, 2]) for _ in range(3)], len(VOCABULARY))
    assert TASKS[metric](room_model(), Setting(silent, STRUCTURE)) is None


def test_a_source_without_positions_has_no_poses():
    data = replace(DATA, scenes=[replace(one, instance_positions=None) for one in DATA.scenes])
    outcome = relations_evidence_task(room_model(), Setting(data, STRUCTURE, limit=5))
    assert {name.split(", ")[1].split()[0] for name in outcome.metrics} == {"relations"}
