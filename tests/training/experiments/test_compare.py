from __future__ import annotations

from dataclasses import replace

from tests.training.baselines.furnished import STRUCTURE, furnished, tensors
from training.baselines import BASELINES
from training.evaluation.setting import Contender
from training.experiments.compare import side_by_side


def test_scenes_with_incomplete_lists_are_compared_on_relations_alone() -> None:
    """Photographs list a few objects each: questions about objects leave these scenes out."""
    train, validation, test = (furnished(60, seed=seed) for seed in range(3))
    scenes = tensors([replace(scene, complete=k % 2 == 0) for k, scene in enumerate(test.scenes)])
    fitted = [
        Contender(
            objects=BASELINES[objects].fit(train, validation, STRUCTURE).score,
            relations=BASELINES["frequency table"].fit(train, validation, STRUCTURE).score,
        )
        for objects in ("EASE", "popularity")
    ]
    results = side_by_side(
        ("a", "b"), (lambda _: fitted[0], lambda _: fitted[1]), scenes, STRUCTURE
    )
    scenes_of = {asked.task: asked.scenes for asked in results.asked if asked.row == "a"}
    assert scenes_of["T1a relations"] == 60
    assert scenes_of["T2 missing"] == 30
    assert {row.task for row in results.differences} >= {"T1a relations", "T2 missing"}
