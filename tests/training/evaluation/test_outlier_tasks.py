"""T3: who is added, by which law, who is found, and when the alarm is raised."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from app.registry import Calibration, CountSlope, Thresholds
from tests.training.evaluation.furnished_rooms import STRUCTURE, VOCABULARY, room_model, rooms
from tests.training.evaluation.scenes import NO_STRUCTURE, WIDE, WIDE_STRUCTURE, scene, tensors
from training.datasets import shuffle_objects
from training.evaluation import outlier_tasks as outliers
from training.evaluation.alarms import ALARMS
from training.evaluation.asking import (
    SENSITIVITIES,
    LeakError,
    ask_every,
    judge,
    labels_alone,
    with_intruder,
)
from training.evaluation.intruders import (
    IntruderScores,
    by_popularity,
    by_room,
    by_signature,
    clean_scores,
    draw_intruders,
    intruder_scores,
    signatures,
)
from training.evaluation.model import Alarm, Model
from training.evaluation.outlier_tasks import (
    alarm_threshold,
    calibrated_alarm,
    fitted_alarm,
    judge_intruders,
    sensitivity_task,
    share_of_first,
    signature_task,
)
from training.evaluation.setting import Setting

TRAIN, DATA = rooms(400, 1), rooms(40, 2)


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
    assert scores.dirty.metric("AUROC").value == pytest.approx(6.5 / 8)
    suspicion = -scores.log_odds
    assert scores.false_alarms(suspicion >= 0.0).value == pytest.approx(1 / 2)
    assert scores.false_alarms(suspicion >= 0.5).value == 0.0
    assert scores.caught(suspicion >= 0.5).value == pytest.approx(1 / 2)
    # Class 0 is often an intruder: the second scene's is found, and the first one's still.
    likely = scores.with_prior(np.array([1.5, 0.0, 0.0]))
    assert likely.log_odds.tolist() == [-0.5, 2, -1, 0, 3, -0.5, -0.5, 2, 0, 3]
    assert likely.hit_at_1().value == 1.0


def test_scores_that_know_everything_or_nothing():
    data = tensors([scene([0, 1, 2]) for _ in range(5)])
    known = lambda v: torch.tensor([5.0, 5, 5, -5, -5]).expand_as(v)  # noqa: E731
    scores = intruder_scores(data, NO_STRUCTURE, known)
    assert scores.hit_at_1().value == scores.dirty.metric("AUROC").value == 1.0
    assert scores.dirty.metric("average precision").value == 1.0
    wrong = intruder_scores(data, NO_STRUCTURE, lambda v: -known(v))
    assert wrong.hit_at_1().value == wrong.dirty.metric("AUROC").value == 0.0
    none = intruder_scores(data, NO_STRUCTURE, torch.zeros_like)
    assert (none.hit_at_1().value, none.dirty.metric("AUROC").value) == pytest.approx(
        (1 / 4, 1 / 2)
    )
    # 5 true ones among 20 equal scores.
    expected = sum((1 + (k - 1) * 4 / 19) / k for k in range(1, 21)) / 20
    assert none.dirty.metric("average precision").value == pytest.approx(expected)


def test_an_object_is_judged_by_the_rest_without_itself():
    seen = []

    def spy(v):
        seen.append(v.sum(1).tolist())
        return torch.zeros_like(v)

    intruder_scores(tensors([scene([0, 1, 2])]), NO_STRUCTURE, spy)
    assert seen == [[2, 2, 2], [3, 3, 3, 3]]


# ------------------------------------------------------------------------------------------- laws


def test_intruders_are_absent_and_no_structure():
    structure = NO_STRUCTURE.clone()
    structure[4] = True
    data = tensors([scene([0, 1, 2]) for _ in range(20)])
    assert set(draw_intruders(data, structure).tolist()) == {3}
    small = tensors([scene([0, 1]), scene([0, 1, 4])])
    assert draw_intruders(small, structure).tolist() == [-1, -1]
    scores = intruder_scores(small, structure, torch.zeros_like)
    assert (len(scores.scene), scores.skipped) == (0, 2)


def test_the_intruder_depends_on_the_scene_alone():
    scenes = [scene([0, 1], []), *(scene([0, 1, 2]) for _ in range(9))]
    together = draw_intruders(tensors(scenes), NO_STRUCTURE).tolist()
    assert together == [int(draw_intruders(tensors([s]), NO_STRUCTURE)[0]) for s in scenes]
    assert len(set(together[1:])) == 2


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
    assert draw_intruders(data, NO_STRUCTURE, by_room(data, train)).tolist() == [3, 4, -1]


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
    typical, share = signatures(TOY)
    assert [np.flatnonzero(row).tolist() for row in typical] == [[0], [1], [2], [], [], []]
    assert share[0].tolist() == [1, 0, 0, 1, 1]
    typical, share = signatures(tensors([*TOY.scenes, *(scene([0, 3], room=6) for _ in range(10))]))
    assert np.isnan(share[6]).all()
    assert not typical[6].any()


@pytest.mark.parametrize(("scenes", "times", "typical"), [(19, 19, 0), (30, 6, 1), (30, 5, 0)])
def test_rare_classes_and_rooms_have_no_signature(scenes, times, typical):
    """Under 20 scenes of the room, or the class in under a fifth of them."""
    some = [scene([0, 3] if k < times else [3], room=0) for k in range(scenes)]
    assert signatures(tensors([*some, *TOY.scenes[30:180]]))[0][0, 0] == typical


def test_intruders_are_typical_of_another_room_and_foreign_to_this_one():
    """Rooms 1 and 2 have one suitable class each; in a hundredth of the scenes is not foreign."""
    asked = [scene([0, 3, 4], room=0), scene([3, 4], room=-1), scene([0, 1, 3], room=0)]
    weights = by_signature(tensors(asked), TOY)
    assert weights.tolist() == [[0, 0.5, 0.5, 0, 0], [0] * 5, [0, 0, 1, 0, 0]]
    often = tensors([*TOY.scenes, scene([0, 2], room=0)])
    assert by_signature(tensors(asked[:1]), often).tolist() == [[0, 1, 0, 0, 0]]


def test_rooms_are_drawn_alike_however_many_classes_they_have():
    weights, (_, share) = by_signature(DATA, TRAIN), signatures(TRAIN)
    assert torch.allclose(weights.sum(1), torch.ones(len(DATA)).double())
    for room, row, present in zip(DATA.room.tolist(), weights, DATA.v, strict=True):
        assert not (row > 0)[present > 0].any()
        assert (share[room][(row > 0).numpy()] < 0.01).all()


def test_shuffled_scenes_have_no_signature():
    """So the control takes its questions from the real ones."""
    shuffled = tensors(shuffle_objects(TRAIN.scenes, STRUCTURE.numpy(), seed=0), len(VOCABULARY))
    assert torch.equal(shuffled.v.sum(0), TRAIN.v.sum(0))
    assert signatures(shuffled)[0].sum() < signatures(TRAIN)[0].sum() / 4


# ------------------------------------------------------------------------------- asked as a robot


def test_the_most_out_of_place_comes_first():
    """Ties in expectation."""
    assert share_of_first(np.array([0.2, 0.9]), -1) == 1.0
    assert share_of_first(np.array([0.5, 0.5]), 0) == 0.5
    assert share_of_first(np.array([-np.inf, 0.5, 0.4]), 2) == 0.0


def test_intruders_are_judged_by_probability_and_by_log_odds(monkeypatch):
    """Class 2 is the likeliest of all, but structure; the intruder is flagged at high alone."""

    def known(artifact, asked, sensitivity):
        last = np.arange(len(asked.objects)) == len(asked.objects) - 1
        flat = np.array([thing.class_index == 2 for thing in asked.objects])
        return np.stack([last + 2.0 * flat, 1.0 * last, last & (sensitivity == "high")], 1)

    monkeypatch.setattr(outliers, "judge", known)
    structure = torch.arange(len(VOCABULARY)) == 2
    data = tensors([scene([0, 1, 2]), scene([0, 1])], len(VOCABULARY))
    found = judge_intruders(room_model(), data, structure, torch.tensor([4, -1]), ", x")
    assert {name: metric.value for name, metric in found.items()} == {
        "hit@1, x": 1.0, "hit@1, x, log-odds alone": 0.0,
        "caught, x, low": 0.0, "caught, x, medium": 0.0, "caught, x, high": 1.0,
    }  # fmt: skip
    assert {metric.n for metric in found.values()} == {1}


def test_a_published_model_is_judged_as_the_service_ranks():
    outcome = signature_task(Model(artifact=room_model()), Setting(DATA, STRUCTURE, TRAIN))
    assert all(f"caught, {name}" in outcome.metrics for name in SENSITIVITIES)
    drawn = draw_intruders(DATA, STRUCTURE, by_signature(DATA, TRAIN))
    k = int((drawn >= 0).nonzero()[0])
    case = with_intruder(room_model(), labels_alone(DATA.scenes[k]), int(drawn[k]))
    p = judge(room_model(), case)[:, 0]
    usable = ~STRUCTURE.numpy()[[thing.class_index for thing in case.objects]]
    hit = float(p[-1] == p[usable].max())
    assert outcome.metrics["hit@1"].numerators[k] == pytest.approx(hit)


def test_a_baseline_ranks_by_log_odds():
    popular = TRAIN.v.mean(0).clamp(1e-3, 1 - 1e-3).logit()
    model = Model(missing=lambda v: popular.expand_as(v))
    metrics = signature_task(model, Setting(DATA, STRUCTURE, TRAIN)).metrics
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
    setting = Setting(DATA, STRUCTURE, TRAIN, limit=12)
    outcome = sensitivity_task(Model(artifact=room_model()), setting)
    names = [f"alarms, medium, {listed} listed" for listed in (1, 2)]
    for figure in ("alarms", "caught, uniform", "caught, by popularity"):
        names += [f"{figure}, {name}" for name in SENSITIVITIES]
    assert all(0 <= outcome.metrics[name].value <= 1 for name in names)
    assert outcome.scenes == 12
    assert sensitivity_task(Model(), setting) is None


def test_no_room_type_no_question():
    model = Model(missing=torch.zeros_like)
    unknown = Setting(tensors([scene([0, 1, 2])]), NO_STRUCTURE, TOY)
    assert signature_task(model, unknown) is None
    assert signature_task(model, Setting(DATA, STRUCTURE)) is None
    assert signature_task(Model(), Setting(DATA, STRUCTURE, TRAIN)) is None


def test_scenes_with_the_first_class_as_intruder_count():
    """Class 0, of room 0, is the only candidate in the first scene; the second has none."""
    data = tensors([scene([1, 2, 3], room=1), scene([0, 1, 2, 3], room=1)])
    model = Model(missing=lambda v: torch.tensor([-1.0, 1, 1, 1, 1]).expand_as(v))
    outcome = signature_task(model, Setting(data, NO_STRUCTURE, TOY))
    assert outcome.scenes == 1
    assert outcome.metrics["hit@1"].value == 1.0


def test_a_planted_cheater_is_caught(monkeypatch):
    """A model that counts the scenes, and flags the intruder of the one whose turn it is."""
    drawn = draw_intruders(DATA, STRUCTURE, by_signature(DATA, TRAIN))
    turns = iter(drawn[drawn >= 0].tolist() * 3)

    def cheat(artifact, asked, sensitivity):
        knows = next(turns)
        hit = np.array([thing.class_index == knows for thing in asked.objects], dtype=float)
        return np.column_stack([hit, -hit, hit])

    monkeypatch.setattr(outliers, "judge", cheat)
    with pytest.raises(LeakError, match="leaks information"):
        signature_task(Model(artifact=room_model()), Setting(DATA, STRUCTURE, TRAIN))
    with pytest.raises(FloatingPointError, match="NaN"):
        ask_every(lambda _: np.array([np.nan]), [1, 2])


# ------------------------------------------------------------------------------------------ alarms


def varied(sizes, seed=0):
    """Scenes of four classes, rare ones common in the second source; four to a place."""
    rng = np.random.default_rng(seed)
    scenes = []
    for source, size in zip("ab", sizes, strict=False):
        weight = np.arange(WIDE, 0, -1.0) ** (3 if source == "a" else 0)
        for k in range(size):
            classes = rng.choice(WIDE, 4, replace=False, p=weight / weight.sum())
            group = f"{source}{seed} {k // 4}"
            scenes.append(scene(sorted(classes.tolist()), source=source, group=group))
    return tensors(scenes, WIDE)


def by_frequency(v):
    """Log-odds that depend on the class alone: many scenes have the same worst one."""
    return -torch.arange(float(WIDE)).expand_as(v)


def smooth(v):
    """Log-odds that differ from scene to scene."""
    return by_frequency(v) + (v @ torch.linspace(0, 1, WIDE) * 10).sin().unsqueeze(1)


def shares(score, alarm, scenes):
    """Share of untouched scenes with an alarm, by source."""
    scores = intruder_scores(scenes, WIDE_STRUCTURE, score)
    loud = alarm.raised(scores)
    alarms = np.bincount(scores.scene[loud & scores.clean], minlength=len(scenes)) > 0
    source = np.array([entry.source for entry in scenes.scenes])
    return {str(name): float(alarms[source == name].mean()) for name in np.unique(source)}


@pytest.mark.parametrize("score", [smooth, by_frequency])
def test_the_promise_is_kept_in_every_large_source(score):
    scenes = varied([400, 400])
    found = shares(score, fitted_alarm(score, scenes, WIDE_STRUCTURE), scenes)
    assert max(found.values()) <= ALARMS["medium"] + 0.02


def test_the_source_that_alarms_most_sets_the_threshold():
    """One quantile over both sources would alarm in the varied one above the promised share."""
    scenes = varied([600, 300])
    both, tame, alone = (
        fitted_alarm(smooth, tensors(some, WIDE), WIDE_STRUCTURE)
        for some in (scenes.scenes, scenes.scenes[:600], scenes.scenes[600:])
    )
    assert both.threshold > tame.threshold
    assert both.threshold == pytest.approx(alone.threshold, abs=0.3)
    assert shares(smooth, both, scenes)["b"] > 0


def test_a_smaller_share_of_alarms_has_a_higher_threshold():
    """And a monotone map of the suspicion moves the threshold with it, and no alarm."""
    scenes = varied([400])
    scores = intruder_scores(scenes, WIDE_STRUCTURE, smooth)
    limits = []
    for share in (0.02, ALARMS["medium"], 0.2):
        alarms = []
        for suspicion in (-scores.log_odds, 1 - 2 * scores.log_odds):
            rng = np.random.default_rng(0)
            limit = alarm_threshold(suspicion, scores, scenes, rng, share)
            alarms.append(scores.false_alarms(suspicion >= limit).value)
        limits.append(limit)
        assert alarms[0] == alarms[1]
        assert 0 < alarms[0] <= share + 0.02
    assert limits == sorted(limits, reverse=True)


def test_a_model_alarms_as_its_service_does():
    """By its probability, with its prior of intruders, at the medium threshold."""
    popularity = tuple(np.linspace(-2.0, 2.0, WIDE).tolist())
    calibration = Calibration.neutral(1).model_copy(
        update={
            "outlier": CountSlope(intercept=0.3, slope=-0.8, log_count=0.2),
            "popularity": popularity,
            "popularity_weight": 0.5,
            "outlier_thresholds": Thresholds(low=0.9, medium=0.4, high=0.1),
        }
    )
    alarm = calibrated_alarm(calibration)
    scores = intruder_scores(tensors([scene([0, 1, 2, 3])], WIDE), WIDE_STRUCTURE, smooth)
    odds = scores.log_odds - 0.5 * np.array(popularity)[scores.thing]
    logits = 0.3 - 0.8 * odds + 0.2 * np.log(scores.size)
    assert alarm.suspicion(scores) == pytest.approx(1 / (1 + np.exp(-logits)))
    assert alarm.threshold == 0.4


def test_an_object_at_the_threshold_of_its_list_raises_the_alarm():
    """Lists of one and two classes have their own thresholds; structure is not listed."""
    structure = torch.arange(WIDE) == 11
    scenes = tensors([scene([0]), scene([0, 11]), scene([0, 1]), scene([0, 1, 2])], WIDE)
    scores = clean_scores(scenes.v, structure, by_frequency)
    limits = np.array([0.5, 0.5, 0.25, 0.125])[scores.scene]
    at, below = (
        Alarm(lambda _, some=some: some, 0.125, (0.5, 0.25)).raised(scores)
        for some in (limits, limits - 1e-6)
    )
    assert at.tolist() == [True] * 7
    assert not below.any()


def test_scenes_with_incomplete_object_lists_fit_no_alarm():
    scenes = varied([300])
    odd = [replace(scene([0, 1, 10, 11]), complete=False) for _ in range(300)]
    alarm = fitted_alarm(smooth, tensors([*scenes.scenes, *odd], WIDE), WIDE_STRUCTURE)
    assert alarm.threshold == fitted_alarm(smooth, scenes, WIDE_STRUCTURE).threshold


def test_without_finite_suspicions_there_is_no_threshold():
    scenes = tensors([scene([0, 1]) for _ in range(5)], WIDE)
    with pytest.raises(ValueError, match="no clean scene"):
        fitted_alarm(smooth, scenes, WIDE_STRUCTURE)
    with pytest.raises(FloatingPointError, match="not finite"):
        fitted_alarm(lambda v: torch.full_like(v, -torch.inf), varied([20]), WIDE_STRUCTURE)
