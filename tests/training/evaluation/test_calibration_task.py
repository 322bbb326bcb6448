from dataclasses import replace
from functools import partial

import numpy as np
import pytest
import torch

from app.model import CountSlope
from app.scene import CANONICAL
from app.scene.spatial_relations import LEFT, ON_TOP
from tests.questions.answers import missing, relations
from tests.questions.artifacts import LARGER, calibration, larger_artifact
from tests.training.evaluation.furnished_rooms import STRUCTURE, room_model, rooms
from tests.training.evaluation.scenes import random_scenes, scene, tensors
from training.datasets.cases import scene_of
from training.evaluation.calibration_task import (
    QUESTIONS,
    ask_outliers,
    collect,
    collect_missing,
    uncalibrated,
)
from training.evaluation.outlier_tasks import draw_intruder_choices
from training.evaluation.parts import draw_parts, exactly

ARTIFACT = larger_artifact("triway")
V = LARGER["triway"].V
DATA = tensors(random_scenes(30, V - 1), V)


def test_the_truth_of_a_relation_is_its_annotation():
    found, _ = collect(ARTIFACT, DATA, QUESTIONS["relations"])
    entry = DATA.scenes[4]
    asked = replace(scene_of(entry, range(len(entry.instance_classes)), ()), room_type=None)
    answers = relations(ARTIFACT, asked)
    listed = [
        bool(entry.instance_holds[CANONICAL.index(a.relation), a.subject, a.object])
        for a in answers
    ]
    ours = found.unit == 4
    assert found.score[ours].tolist() == [answer.probability for answer in answers]
    assert found.truth[ours].tolist() == listed


def test_sentences_tell_the_sides_of_stacked_objects_alone():
    """An object on another one is not beside it. That is no answer to how often it is on it."""
    beside, stacked = (
        scene([0, 1], [triple], source="coco_captions") for triple in ((LEFT, 0, 1), (ON_TOP, 0, 1))
    )
    ask = QUESTIONS["relations"]
    assert collect(ARTIFACT, tensors([beside], V), ask)[0] is None
    assert collect(ARTIFACT, tensors([stacked], V), ask)[0].truth.tolist() == [False] * 4


def test_hidden_classes_are_true_and_nothing_else():
    """All unlisted classes are answered here; of n classes n - 2 are hidden."""
    found, skipped = collect_missing(ARTIFACT, DATA, exactly(2))
    sizes = np.array([(entry.evidence.classes < V - 1).sum() for entry in DATA.scenes])
    hidden = np.bincount(found.unit, weights=found.truth, minlength=30)
    assert hidden.tolist() == np.where(sizes > 2, sizes - 2, 0).tolist()
    answered = np.bincount(found.unit, minlength=30)
    assert answered.tolist() == np.where(sizes > 2, V - 1 - 2, 0).tolist()
    assert skipped == (sizes <= 2).sum()


def test_classes_that_a_source_cannot_show_are_left_out():
    able = torch.arange(V).expand(1, -1) != 3
    some = replace(DATA, annotated_classes=able)
    every, found = (collect_missing(ARTIFACT, data, exactly(2))[0] for data in (DATA, some))
    listed = draw_parts(DATA, torch.arange(V) == V - 1, exactly(2)).v[:, 3]
    assert len(every.score) - len(found.score) == int((listed == 0).sum())


def test_intruders_are_of_every_kind():
    """Uniform, popular, and typical of another room type; without training, uniform alone. Half of
    the 40 scenes have one. Fewer than 7 or more than 33 happen with probability below 1e-4."""
    data, train = rooms(40, 1), rooms(400, 2)
    found = draw_intruder_choices(data, STRUCTURE, train)
    assert set(found) == {(entry.source, entry.scene_id) for entry in data.scenes}
    for entry in data.scenes:
        drawn = found[entry.source, entry.scene_id]
        assert not np.isin(drawn, entry.evidence.classes).any()
    assert max(map(len, found.values())) == 3
    alone = draw_intruder_choices(data, STRUCTURE, None)
    assert {len(drawn) for drawn in alone.values()} <= {0, 1}
    answers, _ = collect(room_model(), data, partial(ask_outliers, intruders=found))
    intruders = np.bincount(answers.unit, weights=answers.truth)
    assert set(intruders.tolist()) == {0.0, 1.0}
    assert 7 <= intruders.sum() <= 33


def test_the_uncalibrated_model_answers_with_its_log_odds():
    plain = uncalibrated(
        replace(ARTIFACT, calibration=calibration(ARTIFACT.spec.A, missing=CountSlope(slope=3.0)))
    )
    asked = replace(scene_of(DATA.scenes[0], range(2), ()), room_type=None)
    for answer in missing(plain, asked):
        assert answer.probability == pytest.approx(1 / (1 + np.exp(-answer.log_odds)), rel=1e-4)
