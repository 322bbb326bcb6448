from dataclasses import replace
from functools import partial

import numpy as np
import pytest
import torch

from app import questions
from tests.training.evaluation.furnished_rooms import STRUCTURE, VOCABULARY, room_model, rooms
from tests.training.evaluation.scenes import NO_STRUCTURE, V, scene, tensors
from training.evaluation.asking import score_rooms
from training.evaluation.object_tasks import LEAST, LISTS, mean_log_p, rooms_task
from training.evaluation.parts import of_classes
from training.evaluation.setting import Setting

DATA = tensors([scene([k % 2, 2, 3, 4], room=k % 3) for k in range(30)], V)
SETTING = Setting(DATA, NO_STRUCTURE)


def by_first(v, profile):
    """Room type 0 if class 0 is listed, else 1; with a named profile, always type 0."""
    log_p = torch.full((len(v), 2), 0.2).log()
    likeliest = (v[:, 0] == 0).long() * (profile == "")
    return log_p.scatter(1, likeliest.unsqueeze(1), float(np.log(0.8)))


def test_figures_by_hand():
    """Scene k has the type k % 3 and the answer k % 2; the model cannot name the type 2."""
    metrics = rooms_task(by_first, SETTING).metrics
    types, answers = np.arange(30) % 3, np.arange(30) % 2
    hit = types == answers
    assert metrics["top-1, all classes"].value == pytest.approx(hit.mean())
    assert metrics["top-3, all classes"].value == pytest.approx((types < 2).mean())
    loss = -np.log(np.where(types == 2, LEAST, np.where(hit, 0.8, 0.2)))
    assert metrics["log-loss, all classes"].value == pytest.approx(loss.mean())
    assert metrics["ECE, all classes"].value == pytest.approx(abs(0.8 - hit.mean()))
    named = metrics["top-1, all classes, profile named"]
    assert named.value == pytest.approx((types == 0).mean())


def test_short_lists_are_shorter_and_need_more_classes():
    lengths = []

    def listening(v, profile):
        lengths.append(v.sum(1))
        return by_first(v, profile)

    metrics = rooms_task(listening, SETTING).metrics
    # A scene of four classes has no part of 4.
    assert set(torch.cat(lengths).tolist()) == {4.0, 2.0}
    assert {name.split(", ")[1] for name in metrics} == {"all classes", "2 classes"}
    assert metrics["top-1, 2 classes"].n == 3 * 30


def test_only_scenes_with_a_room_type_take_part():
    silent = replace(DATA, room=torch.full((30,), -1))
    assert rooms_task(by_first, Setting(silent, NO_STRUCTURE)) is None
    with pytest.raises(ValueError, match="no scene has a room type"):
        mean_log_p(silent, NO_STRUCTURE, by_first)


def test_real_rooms_have_their_own_rows():
    real = [replace(one, source="3dssg") for one in DATA.scenes]
    metrics = rooms_task(by_first, Setting(tensors(real, V), NO_STRUCTURE)).metrics
    assert metrics["top-1, 2 classes, real rooms"].value == metrics["top-1, 2 classes"].value
    both = rooms_task(by_first, Setting(tensors([*real, *DATA.scenes], V), NO_STRUCTURE))
    assert not [name for name in both.metrics if "real" in name or "named" in name]


def test_room_scores_are_those_of_the_service():
    scenes = rooms(6, 3)
    score = partial(score_rooms, room_model(), ())
    v = scenes.v * ~STRUCTURE
    log_p = score(v, "a profile of another model")
    for row, values in zip(v, log_p, strict=True):
        listed = of_classes(row.nonzero().squeeze(1).tolist())
        (first, *_) = questions.rooms(room_model(), listed)["room_types"]
        assert VOCABULARY.room_types[int(values.argmax())] == first["room_type"]
        assert float(values.max().exp()) == pytest.approx(first["probability"], abs=1e-6)
    assert log_p.exp().sum(1) == pytest.approx(1.0, abs=1e-3)
    outcome = rooms_task(score, Setting(scenes, STRUCTURE))
    assert all(f"top-1, {name}" in outcome.metrics for name in LISTS)
