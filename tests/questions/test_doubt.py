"""Doubt: the probability that a detection is right, and the weights of doubtful objects."""

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from app.model import RealFit
from app.model.calibration import CountSlope
from app.questions.doubt import LONG_LIST, believed, doubt, room_odds
from app.questions.posterior import Posterior
from app.scene import Scene
from tests.questions.answers import misplaced, missing, outliers, rooms
from tests.questions.artifacts import LABELS, LARGER, judging, larger_artifact, lines, scene_of

LINE = CountSlope(intercept=0.3, slope=-0.9, log_count=-0.2)
FIT = RealFit(intercept=0.4, confidence=1.5, context=0.7, log_count=-0.3)
ALARM = lines(-1e3, -1e3, -1e3)
POPULARITY = tuple(np.linspace(-3, 2, len(LABELS)).tolist())
CLASSES = [0, 1, 3, 3, 6]


def doubting(name: str = "triway-states", **changes: object):
    options = {"popularity": POPULARITY, "popularity_weight": 0.5, "outlier_lines": ALARM}
    return larger_artifact(name, **{"outlier": LINE, "real": FIT, **options, **changes})


def seen(classes: list[int], confidence: list[float], **options: object) -> Scene:
    scene = scene_of(classes, **options)
    pairs = zip(scene.objects, confidence, strict=True)
    return replace(scene, objects=tuple(replace(one, confidence=c) for one, c in pairs))


def sigmoid(x: float) -> float:
    return 1 / (1 + math.exp(-x))


@pytest.fixture(params=LARGER)
def artifact(request):
    return doubting(request.param)


def test_real_follows_its_formula(artifact):
    confidence = [0.9, 0.3, 0.6, 0.05, 1.0]
    scene = seen(CLASSES, confidence)
    posterior = Posterior(artifact, scene)
    z = dict(zip(posterior.present.classes, posterior.given_rest()[0], strict=True))
    real = {one.object: one.real for one in outliers(artifact, scene).outliers}
    for row, (index, c) in enumerate(zip(CLASSES[:-1], confidence, strict=False)):
        score = z[index] - 0.5 * POPULARITY[index]
        logit = 0.4 + 1.5 * math.log(c / (1 - c)) + 0.7 * score - 0.3 * math.log(4)
        assert real[row] == pytest.approx(sigmoid(logit), rel=1e-4)
    assert real[4] == 1.0


def test_without_confidences_every_object_is_real_and_the_field_is_absent(artifact):
    answer = outliers(artifact, scene_of(CLASSES), threshold=0.0)
    assert not any(hasattr(one, "real") for one in answer.outliers)
    assert {one.reason for one in answer.outliers} == {"does-not-belong"}


def test_a_wrong_detection_is_no_outlier(artifact):
    scene = seen([0, 1, 3], [1.0, 1.0, 1e-5])
    answer = outliers(artifact, scene, threshold=0.0)
    by_object = {one.object: one for one in answer.outliers}
    assert by_object[2].real < 0.5
    assert (by_object[2].is_outlier, by_object[2].reason) == (False, "misdetection")
    assert all(by_object[k].is_outlier for k in (0, 1))


def test_one_object_of_a_class_may_be_wrong_and_another_one_right():
    scene = seen([0, 1, 3, 3], [1.0, 1.0, 0.9999, 1e-5])
    answer = outliers(doubting(), scene, threshold=0.0)
    first, second = (one for one in answer.outliers if one.label == "chair")
    assert first.probability == second.probability
    assert {one.object: one.is_outlier for one in (first, second)} == {2: True, 3: False}


def test_a_wrong_detection_is_not_misplaced():
    artifact = doubting(misplaced=judging(lines(-99.0, -99.0, -99.0)))
    relations = [(2, 1, 0)]  # on top
    for confidence, expected in ((1.0, True), (0.001, False)):
        scene = seen([0, 1], [1.0, confidence], relations=relations)
        (entry,) = misplaced(artifact, scene)
        assert entry.is_misplaced == expected


def test_the_context_of_a_single_class_is_unknown():
    scene = seen([0], [0.6])
    (entry,) = outliers(doubting(), scene).outliers
    assert entry.real == pytest.approx(sigmoid(0.4 + 1.5 * math.log(1.5)), rel=1e-4)
    assert not entry.is_outlier


def test_without_a_fit_the_confidence_is_the_probability():
    artifact = doubting(real=None)
    real = {one.object: one.real for one in outliers(artifact, seen([0, 1], [0.7, 0.2])).outliers}
    assert real == pytest.approx({0: 0.7, 1: 0.2})


@given(st.floats(0.01, 0.98), st.floats(0.001, 0.01))
def test_real_grows_with_the_confidence(confidence, step):
    artifact = doubting()
    values = [
        next(one.real for one in outliers(artifact, seen(CLASSES, [*[0.8] * 4, c])).outliers
             if one.object == 4)
        for c in (confidence, confidence + step)
    ]  # fmt: skip
    assert values[0] < values[1]


def test_the_presence_is_weighted_by_real_and_by_the_probability_to_belong(artifact):
    confidence = [0.9, 0.3, 0.6, 0.4, 1.0]
    scene = seen(CLASSES, confidence)
    posterior = Posterior(artifact, scene)
    about = doubt(artifact, posterior, posterior.given_rest()[0])
    some_chair = 1 - (1 - about.real[2]) * (1 - about.real[3])
    exists = np.array([about.real[0], about.real[1], some_chair, 1.0])
    weighted = believed(artifact, scene)
    assert weighted.present.presence == pytest.approx(exists * (1 - about.p), rel=1e-5)
    W = artifact.weights["W"][weighted.present.classes]
    x = artifact.weights["c1"] + weighted.present.presence @ W
    assert weighted.context.x == pytest.approx(x, abs=1e-4)


def test_a_doubtful_object_does_not_speak_for_other_answers():
    """An object that is certainly wrong changes no answer. So does a certain intruder."""
    with_weak = seen([0, 1, 3], [1.0, 1.0, 1e-9])
    certain = doubting(outlier=CountSlope(intercept=-200.0))
    assert log_odds(certain, with_weak, "desk") == pytest.approx(
        log_odds(certain, scene_of([0, 1]), "desk"), rel=1e-4
    )
    room, expected = (rooms(certain, scene)[0] for scene in (with_weak, scene_of([0, 1])))
    assert room.room_type == expected.room_type
    assert room.probability == pytest.approx(expected.probability, rel=1e-4)
    intruders = doubting(outlier=CountSlope(intercept=200.0))
    assert log_odds(intruders, scene_of([0, 1, 3]), "desk") == pytest.approx(
        log_odds(certain, scene_of([]), "desk"), rel=1e-4
    )


def log_odds(artifact, scene, label):
    return next(
        one.log_odds for one in missing(artifact, scene, coverage=0.5, candidates=[2])
        if one.label == label
    )  # fmt: skip


def test_doubt_reduces_the_reasons():
    """The effect of each object on another one shrinks by its weight."""
    artifact = doubting()
    sure, unsure = (outliers(artifact, seen([0, 1, 3], [1.0, 1.0, c])).outliers for c in (1.0, 0.3))
    effects = [
        abs(reason.log_odds_change)
        for entries in (sure, unsure)
        for one in entries if one.object == 0
        for reason in one.because if reason.object == 2
    ]  # fmt: skip
    assert len(effects) < 2 or effects[1] < effects[0]


@pytest.mark.parametrize("name", [name for name, spec in LARGER.items() if spec.C])
def test_the_room_type_is_a_mixture_over_the_intruder(name):
    """Of five classes, the least probable intruder has no hypothesis."""
    artifact = doubting(name)
    classes = [0, 1, 3, 5, 6]
    posterior = Posterior(artifact, scene_of(classes))
    logits = doubt(artifact, posterior, posterior.given_rest()[0]).logits
    least = int(logits.argmin())
    p, total = np.exp(posterior.room_log_p()[0]), 1.0
    for row, index in enumerate(classes):
        if row != least:
            others = [one for one in classes if one != index]
            weight = math.exp(logits[row]) * (math.e * 5 / LONG_LIST) ** 2
            p = p + weight * np.exp(Posterior(artifact, scene_of(others)).room_log_p()[0])
            total += weight
    log_p = room_odds(artifact, scene_of(classes, room=1)).log_p
    assert np.exp(log_p) == pytest.approx(p / total, rel=2e-3)


def test_the_room_type_of_a_single_class_is_that_of_the_machine():
    artifact = doubting(outlier=CountSlope(intercept=200.0))
    log_p = room_odds(artifact, scene_of([0])).log_p
    assert log_p == pytest.approx(Posterior(artifact, scene_of([0])).room_log_p()[0], rel=1e-5)
