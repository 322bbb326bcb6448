from __future__ import annotations

import io
from dataclasses import replace
from pathlib import Path

import pytest
from rich.console import Console

from app.scene import Vocabulary
from tests.training.research.baselines.furnished import STRUCTURE, furnished, tensors
from training.domain.candidates import Candidate
from training.domain.compare import COMPARED, compare, show, side_by_side
from training.evaluation.baselines import EASE, FREQUENCY_TABLE, POPULARITY
from training.evaluation.model import Model
from training.evaluation.tasks import in_words
from training.fit.configuration import Config
from training.fit.draft import as_stored, draft_artifact
from training.fit.objects import ObjectScenes
from training.fit.trainer import new_machine
from training.runs.pipeline import prepare

CONFIG = Config.model_validate(
    {
        "name": "small",
        "data": {"sources": ["rooms"], "rooms": 120, "vocabulary": "rooms", "split": "stable"},
        "machine": {"variant": "rbm", "units": 2, "states": 3, "N": 0},
    }
)


def test_scenes_with_incomplete_lists_are_compared_on_relations_alone() -> None:
    """Photographs list a few objects each: questions about objects leave these scenes out."""
    train, validation, test = (furnished(60, seed=seed) for seed in range(3))
    scenes = tensors([replace(scene, complete=k % 2 == 0) for k, scene in enumerate(test.scenes)])
    fitted = [
        Model(
            missing=baseline.fit(train, validation, STRUCTURE).missing,
            relations=FREQUENCY_TABLE.fit(train, validation, STRUCTURE).relations,
        )
        for baseline in (EASE, POPULARITY)
    ]
    results = side_by_side(("a", "b"), (fitted[0], fitted[1]), scenes, STRUCTURE)
    scenes_of = {asked.task: asked.scenes for asked in results.asked if asked.row == "a"}
    assert scenes_of["T1a relations"] == 60
    assert scenes_of["T2 missing"] == 30
    assert {row.task for row in results.differences} >= {"T1a relations", "T2 missing"}


@pytest.mark.parametrize("lacking", [0, 1])
def test_a_comparison_fits_into_80_columns_and_notes_lacking_classes_alone(lacking) -> None:
    """The second model has the classes in another order, all of them or all but one."""
    scenes = prepare(CONFIG, Path())
    classes = list(reversed(scenes.vocabulary.objects))
    if lacking:
        classes[0] = replace(classes[0], label="unheard of", aliases=())
    data = scenes.training_data()
    objects = ObjectScenes.of(data.train, data.structure, CONFIG.objects)
    machine = new_machine(CONFIG, data, objects)
    other = Vocabulary(classes, scenes.vocabulary.room_types)
    a, b = (
        Candidate(title, CONFIG, scenes.digests, draft_artifact(as_stored(machine), vocabulary))
        for title, vocabulary in (("new", scenes.vocabulary), ("old", other))
    )
    found = compare(a, b, Path(), say=lambda _: None)
    assert ["old lacks 1 of these classes" in note for note in found.notes] == [True] * lacking
    assert {row.task for row in found.results.differences} == set(COMPARED)
    console = Console(file=io.StringIO(), width=80)
    show(found, console)
    lines = [line.strip() for line in console.file.getvalue().splitlines()]
    for row in found.results.differences:
        assert in_words(row.task) in lines
        # The name of a metric, its values and the verdict are on one line.
        assert any(
            line.startswith(f"{row.metric} ") and line.endswith(f"] {row.verdict}")
            for line in lines
        )
