"""T3 signature: who is typical of which room, who is drawn, and how the service judges them."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from tests.training.evaluation.furnished_rooms import STRUCTURE, VOCABULARY, room_model, rooms
from tests.training.evaluation.scenes import NO_STRUCTURE, scene, tensors
from training.datasets import shuffle_objects
from training.evaluation import signature
from training.evaluation.asking import SENSITIVITIES, ask_every, judge, labels_alone
from training.evaluation.contenders import Contender
from training.evaluation.missing import LeakError
from training.evaluation.outliers import draw_intruders
from training.evaluation.setting import Setting
from training.evaluation.signature import (
    Judged,
    by_signature,
    sensitivity_task,
    signature_task,
    signatures,
)

TRAIN, DATA = rooms(400, 1), rooms(40, 2)

# Of six rooms 0, 1 and 2 have a class of their own each; 3 is everywhere, and 4 in rooms 0 and 1.
TOY = tensors(
    [scene([0, 3, 4], room=0) for _ in range(30)]
    + [scene([1, 3, 4], room=1) for _ in range(30)]
    + [scene([2, 3], room=2) for _ in range(30)]
    + [scene([3], room=room) for room in (3, 4, 5) for _ in range(30)]
    + [scene([2, 3]) for _ in range(50)]
)


def test_the_signature_of_a_room_is_what_is_often_there_and_seldom_elsewhere():
    """Lift of its own class 180 / 30 = 6; of class 4 in rooms 0 and 1 3; of class 3 1."""
    found = signatures(TOY)
    assert [np.flatnonzero(row).tolist() for row in found.typical] == [[0], [1], [2], [], [], []]
    assert found.share[0].tolist() == [1, 0, 0, 1, 1]


def test_rare_classes_and_rooms_are_left_out():
    few = tensors([*TOY.scenes, *(scene([0, 3], room=6) for _ in range(10))])
    found = signatures(few)
    assert np.isnan(found.share[6]).all()
    assert not found.typical[6].any()
    rare = tensors([scene([0, 3], room=0) for _ in range(19)] + list(TOY.scenes[30:180]))
    assert not signatures(rare).typical[0].any()
    # In six of thirty scenes it is often there, in five it is not.
    for times, typical in ((6, True), (5, False)):
        some = [scene([0, 3] if k < times else [3], room=0) for k in range(30)]
        found = signatures(tensors([*some, *TOY.scenes[30:180]]))
        assert bool(found.typical[0, 0]) == typical


def test_intruders_are_typical_of_another_room_and_foreign_to_this_one():
    weights = by_signature(tensors([scene([0, 3, 4], room=0), scene([3, 4], room=-1)]), TOY)
    # Rooms 1 and 2 have one suitable class each.
    assert weights[0].tolist() == [0, 0.5, 0.5, 0, 0]
    assert weights[1].sum() == 0
    there = by_signature(tensors([scene([0, 1, 3], room=0)]), TOY)
    assert there[0].tolist() == [0, 0, 1, 0, 0]


def test_what_is_in_a_hundredth_of_the_scenes_is_not_foreign():
    often = tensors([*TOY.scenes, scene([0, 2], room=0)])
    weights = by_signature(tensors([scene([0, 3, 4], room=0)]), often)
    assert weights[0].tolist() == [0, 1, 0, 0, 0]


def test_rooms_are_drawn_alike_however_many_classes_they_have():
    data = by_signature(DATA, TRAIN)
    assert torch.allclose(data.sum(1), torch.ones(len(DATA)).double())
    found = signatures(TRAIN)
    for room, row, present in zip(DATA.room.tolist(), data, DATA.v, strict=True):
        assert not (row > 0)[present > 0].any()
        assert (found.share[room][(row > 0).numpy()] < 0.01).all()


def test_the_most_out_of_place_comes_first():
    """By probability for the service, by log-odds beside it; ties in expectation."""
    scores = [
        np.array([[0.9, 1.0, 1], [0.2, 0.0, 0]]),
        np.array([[0.5, 2.0, 1], [0.5, 3.0, 0]]),
    ]
    asked = np.array([True, False, True])
    judged = Judged(asked, scores, {"medium": np.array([True, False, False])})
    assert judged.hit_at_1().numerators.tolist() == [1, 0, 0.5]
    assert judged.hit_at_1(1).numerators.tolist() == [0, 0, 1]
    assert judged.caught("medium").value == 0.5


def test_a_published_model_is_judged_as_the_service_ranks():
    outcome = signature_task(Contender(artifact=room_model()), Setting(DATA, STRUCTURE, TRAIN))
    assert {"hit@1", "hit@1, log-odds alone"} < set(outcome.metrics)
    assert all(f"caught, {name}" in outcome.metrics for name in SENSITIVITIES)
    drawn = draw_intruders(DATA, STRUCTURE, by_signature(DATA, TRAIN))
    k = int((drawn >= 0).nonzero()[0])
    case = signature.with_intruder(room_model(), labels_alone(DATA.scenes[k]), int(drawn[k]))
    p = judge(room_model(), case).probability
    usable = ~STRUCTURE.numpy()[[thing.class_index for thing in case.objects]]
    hit = float(p[-1] == p[usable].max())
    assert outcome.metrics["hit@1"].numerators[k] == pytest.approx(hit)


def test_a_baseline_ranks_by_log_odds():
    popular = TRAIN.v.mean(0).clamp(1e-3, 1 - 1e-3).logit()
    contender = Contender(objects=lambda v: popular.expand_as(v))
    metrics = signature_task(contender, Setting(DATA, STRUCTURE, TRAIN)).metrics
    assert set(metrics) == {"hit@1", "hit@1, log-odds alone"}
    drawn = draw_intruders(DATA, STRUCTURE, by_signature(DATA, TRAIN))
    hits = []
    for c, v in zip(drawn.tolist(), DATA.v, strict=True):
        if c >= 0:
            least = popular[(v > 0) & ~STRUCTURE].min()
            ties = int((popular[(v > 0) & ~STRUCTURE] == popular[c]).sum())
            hits.append(float(popular[c] <= least) / (1 + ties))
    assert metrics["hit@1"].value == pytest.approx(np.mean(hits))


def test_every_sensitivity_has_alarms_and_catches():
    outcome = sensitivity_task(
        Contender(artifact=room_model()), Setting(DATA, STRUCTURE, TRAIN, limit=12)
    )
    for name in SENSITIVITIES:
        for figure in ("alarms", "caught, uniform", "caught, by popularity"):
            assert 0 <= outcome.metrics[f"{figure}, {name}"].value <= 1
    for listed in (1, 2):
        assert 0 <= outcome.metrics[f"alarms, medium, {listed} listed"].value <= 1
    assert outcome.scenes == 12
    assert sensitivity_task(Contender(), Setting(DATA, STRUCTURE, TRAIN)) is None


def test_no_room_type_no_question():
    setting = Setting(tensors([scene([0, 1, 2])]), NO_STRUCTURE, TOY)
    contender = Contender(objects=torch.zeros_like)
    assert signature_task(contender, setting) is None
    assert signature_task(contender, Setting(DATA, STRUCTURE)) is None
    assert signature_task(Contender(), Setting(DATA, STRUCTURE, TRAIN)) is None


def test_shuffled_scenes_have_no_signature():
    """So the control takes its questions from the real ones, and popularity answers alike."""
    shuffled = tensors(shuffle_objects(TRAIN.scenes, STRUCTURE.numpy(), seed=0), len(VOCABULARY))
    assert torch.equal(shuffled.v.sum(0), TRAIN.v.sum(0))
    assert signatures(shuffled).typical.sum() < signatures(TRAIN).typical.sum() / 4
    found = []
    for train in (TRAIN, shuffled):
        popular = train.v.mean(0).clamp(1e-3, 1 - 1e-3).logit()
        contender = Contender(objects=lambda v, p=popular: p.expand_as(v))
        found.append(signature_task(contender, Setting(DATA, STRUCTURE, TRAIN)).metrics["hit@1"])
    assert found[0].value == pytest.approx(found[1].value)


def test_a_planted_cheater_is_caught(monkeypatch):
    """A model that counts the scenes, and flags the intruder of the one whose turn it is."""
    drawn = draw_intruders(DATA, STRUCTURE, by_signature(DATA, TRAIN))
    turns = iter(drawn[drawn >= 0].tolist() * 3)

    def cheat(artifact, sensitivity, asked):
        knows = next(turns)
        hit = np.array([thing.class_index == knows for thing in asked.objects], dtype=float)
        return np.column_stack([hit, -hit, hit])

    monkeypatch.setattr(signature, "verdict", cheat)
    with pytest.raises(LeakError, match="something leaks"):
        signature_task(Contender(artifact=room_model()), Setting(DATA, STRUCTURE, TRAIN))


def test_answers_that_are_no_numbers_are_an_error():
    with pytest.raises(FloatingPointError, match="not a number"):
        ask_every(lambda _: np.array([np.nan]), [1, 2])
    assert VOCABULARY.room_types
