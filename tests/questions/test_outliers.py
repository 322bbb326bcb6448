"""The probability of an outlier, the thresholds, and the companions of an outlier."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch

from app.model.calibration import CountSlope
from app.questions.posterior import Posterior
from tests.questions.answers import misplaced, missing, outliers
from tests.questions.artifacts import LABELS, STRUCTURE, judging, larger_artifact, lines, scene_of
from training.machines import machine_of

LINE = CountSlope(intercept=0.2, slope=-0.8, log_count=0.1)
LEVELS = ("low", "medium", "high")
VARIANTS = ["rbm", "gbm", "triway-states"]
SLOPE = -0.6
LINES = lines(2.0, 0.9, -0.4, log_count=SLOPE)
ROOM_LINES = lines(3.0, 1.9, 0.4, log_count=0.1)


def check_probabilities(artifact, scene, priors):
    """By the log-odds of each of three classes given the rest of its scene, less its prior."""
    posterior = Posterior(artifact, scene)
    labels = [LABELS[k] for k in posterior.present.classes.tolist()]
    presence = dict(zip(labels, posterior.given_rest()[0].tolist(), strict=True))
    for entry in outliers(artifact, scene).outliers:
        logit = 0.2 - 0.8 * (presence[entry.label] - priors[entry.label]) + 0.1 * math.log(3)
        assert entry.log_odds == pytest.approx(logit, rel=1e-4)
        assert entry.probability == pytest.approx(1 / (1 + math.exp(-logit)), rel=1e-4)


@pytest.mark.parametrize("alpha", [0.0, 0.5, 1.0])
def test_the_popularity_of_a_class_counts_by_its_weight(alpha):
    popularity = tuple(np.linspace(-3, 2, len(LABELS)).tolist())
    options = {"popularity": popularity, "popularity_weight": alpha}
    artifact = larger_artifact("triway", outlier=LINE, **options)
    priors = {label: alpha * x for label, x in zip(LABELS, popularity, strict=True)}
    check_probabilities(artifact, scene_of([0, 1, 1, 2]), priors)


def test_a_class_without_training_scene_counts_as_the_rarest():
    unseen = LABELS.index("lamp")
    popularity = tuple(None if k == unseen else -1.0 - k for k in range(len(LABELS)))
    options = {"popularity": popularity, "popularity_weight": 0.5}
    artifact = larger_artifact("triway-states", outlier=LINE, **options)
    empty = missing(artifact, scene_of([]), coverage=1.0, top_k=len(LABELS))
    (alone,) = (entry.log_odds for entry in empty if entry.label == "lamp")
    priors = {"bed": -0.5, "lamp": alone + 0.5 * 9, "desk": -1.5}
    check_probabilities(artifact, scene_of([0, unseen, 2]), priors)


@pytest.mark.parametrize("level", LEVELS)
def test_a_rarely_shown_class_raises_no_alarm_at_a_sensitivity(level):
    """It keeps its probability. A warning names its objects, and a stated threshold applies."""
    common, rare, unseen = 0, 1, 2
    popularity = [0.0] * len(LABELS)
    popularity[rare], popularity[unseen] = math.log(1 / 510), None
    popularity[common] = math.log(1 / 490)
    artifact = larger_artifact(
        "triway", outlier=CountSlope(intercept=9.0), outlier_lines=LINES, popularity=popularity
    )
    scene = scene_of([common, rare, rare, unseen])
    objects = [replace(thing, label="robot's own word") for thing in scene.objects]
    scene = replace(scene, objects=tuple(objects))
    answer = outliers(artifact, scene, sensitivity=level)
    flagged = {one.object for one in answer.outliers if one.is_outlier}
    assert all(one.probability > answer.threshold for one in answer.outliers)
    ids = [thing.id for thing in scene.objects]
    assert flagged == {0}
    (warning,) = answer.warnings
    assert (warning.code, warning.objects) == ("not-judged", ids[1:])
    assert all(LABELS[k] in warning.message for k in (rare, unseen))
    stated = outliers(artifact, scene, threshold=answer.threshold)
    assert all(one.is_outlier for one in stated.outliers)
    assert not stated.warnings
    certain = outliers(artifact, scene, sensitivity=level, threshold=0.0)
    assert all(one.is_outlier for one in certain.outliers)


def line(level: str, classes: int) -> float:
    """The probability of the alarm line of a sensitivity at a number of listed classes."""
    logit = {"low": 2.0, "medium": 0.9, "high": -0.4}[level] + SLOPE * math.log(max(1, classes))
    return 1 / (1 + math.exp(-logit))


@pytest.mark.parametrize("name", VARIANTS)
@pytest.mark.parametrize(
    ("classes", "listed"),
    [([], 1), ([0], 1), ([8], 1), ([0, 0, 8], 1), ([0, 1, 1], 2), ([0, 1, 2, 3, 4, 8], 5)],
)
def test_the_threshold_is_the_alarm_line_at_the_number_of_listed_things(name, classes, listed):
    """Distinct classes without structure; a single one is not judged. A request may replace it."""
    artifact = larger_artifact(name, outlier=LINE, outlier_lines=LINES)
    scene, flags = scene_of(classes), set()
    things = [thing.id for thing in scene.objects if thing.label not in STRUCTURE]
    warnings = [("not-judged", things)] if things and listed == 1 else []
    for level in LEVELS:
        answer = outliers(artifact, scene, sensitivity=level)
        threshold = line(level, listed)
        assert answer.threshold == pytest.approx(threshold, rel=1e-5)
        assert [(one.code, one.objects) for one in answer.warnings] == warnings
        for one in answer.outliers:
            assert one.is_outlier == (one.probability >= threshold and listed > 1)
            flags.add(one.is_outlier)
        own = outliers(artifact, scene, sensitivity=level, threshold=0.5)
        assert own.threshold == 0.5
        for one in own.outliers:
            assert one.is_outlier == (one.probability >= 0.5 and listed > 1)
    assert outliers(artifact, scene) == outliers(artifact, scene, sensitivity="medium")
    assert listed < 5 or flags == {True, False}


def test_a_stated_room_type_has_alarm_lines_of_its_own():
    artifact = larger_artifact("triway", outlier=LINE, outlier_lines=LINES, room_lines=ROOM_LINES)
    for room, own in ((None, LINES), (1, ROOM_LINES)):
        answer = outliers(artifact, scene_of([0, 1, 2], room=room), sensitivity="low")
        assert answer.threshold == pytest.approx(own.low.threshold(3), rel=1e-5)


def test_what_probably_belongs_is_no_outlier():
    """A line may lie so low that it would flag what probably belongs."""
    artifact = larger_artifact("triway", outlier=LINE, outlier_lines=lines(-9.0, -9.0, -9.0))
    for level, least in {"low": 0.5, "medium": 0.3, "high": 0.15}.items():
        assert outliers(artifact, scene_of([0, 1, 2]), sensitivity=level).threshold == least


@pytest.mark.parametrize("name", VARIANTS)
def test_the_sensitivity_selects_the_alarm_line_of_misplaced_relations(name):
    """n is the number of relations of one kind. The threshold of a request is for objects only."""
    artifact = larger_artifact(name, misplaced=judging(LINES))
    scene = scene_of([0, 1, 2, 3], [(2, 1, 0), (0, 1, 2), (1, 3, 0)])
    for level in LEVELS:
        answer = outliers(artifact, scene, sensitivity=level)
        for one in answer.misplaced:
            threshold = line(level, 1 if one.relation == "on-top" else 2)
            assert one.is_misplaced == (one.probability >= threshold)
        assert answer.misplaced == misplaced(artifact, scene, sensitivity=level)
        own = outliers(artifact, scene, sensitivity=level, threshold=0.5)
        assert own.misplaced == answer.misplaced


@pytest.mark.parametrize("name", VARIANTS)
def test_companions_raise_the_log_odds_of_an_outlier_most(name):
    """In a scene with only the companion and the outlier, of one data source."""
    artifact = larger_artifact(name)
    machine, none = machine_of(artifact.weights), torch.zeros(1, len(LABELS))

    def log_odds(j, *listed):
        v = none.index_fill(1, torch.tensor(listed, dtype=torch.int64), 1.0)
        return float(machine.object_log_odds(v, source=torch.tensor([0]))[0, j])

    entries = outliers(artifact, scene_of([0, 1, 2]), threshold=0.0).outliers
    assert any(entry.usually_with for entry in entries)
    for entry in entries:
        i = LABELS.index(entry.label)
        increases = {
            label: log_odds(j, i) - log_odds(j)
            for j, label in enumerate(LABELS)
            if label not in {*STRUCTURE, *LABELS[:3]}
        }
        largest = max(increases.values())
        assert all(increases[label] >= 0.5 * largest - 1e-4 for label in entry.usually_with)
        assert bool(entry.usually_with) == (largest > 1e-6)
