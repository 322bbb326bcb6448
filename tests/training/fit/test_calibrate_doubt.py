import numpy as np
import pytest
from scipy.special import expit

from app.model import CountSlope, LabelFit, RealFit
from app.questions.alternatives import Guesses, label_log_odds
from app.questions.doubt import doubt
from app.questions.posterior import Posterior
from tests.questions.artifacts import LABELS, larger_artifact
from tests.training.evaluation.scenes import scene
from training.datasets.detections import GHOST, INTRUDER, Detections
from training.fit import calibrate_doubt
from training.fit.calibrate_doubt import fit_doubt, pair_features, real_features, seen_scene
from training.fit.regression import recalibrated

V = len(LABELS)
POPULARITY = tuple(np.linspace(-3.0, 1.0, V - 1).tolist())
OUTLIER = CountSlope(intercept=-2.0, slope=-1.0)


@pytest.fixture(scope="module")
def model():
    return larger_artifact("triway-states", popularity=(*POPULARITY, None), outlier=OUTLIER)


def seen_by(model, rng, *, fit=None, labels=None):
    """Detections with confidences from (0, 1), which are right as often as a fit states."""
    classes = rng.permutation(V - 1)[: rng.integers(2, 7)]
    n = len(classes)
    confidence, rest = rng.uniform(0.02, 0.98, n), np.full(n, -1)
    seen = Detections(classes, confidence, classes.copy(), rest, np.zeros(n))
    if fit is not None:
        x = real_features(model, seen) @ [fit.confidence, fit.context, fit.log_count]
        wrong = rng.random(n) > expit(x + fit.intercept)
        return seen._replace(truth=np.where(wrong, GHOST, classes))
    other = np.full(n, -1)
    other[0] = rng.choice(np.setdiff1d(np.arange(V - 1), classes))
    seen = seen._replace(other=other, other_confidence=rng.uniform(0.02, 0.98, n))
    difference = pair_features(model, seen)[0]
    wrong = rng.random() > expit(difference @ [labels.confidence, labels.context])
    return seen._replace(truth=np.where(np.arange(n) == 0, other if wrong else classes, classes))


class Drawn:
    """A detector whose detections are right as often as a fit states."""

    def __init__(self, *arguments, **options):
        self.arguments, self.options = arguments, options

    def draw(self, encoded, structure, rng):
        return seen_by(*self.arguments, rng, **self.options)

    def with_intruder(self, seen, present, rng):
        return seen


def test_the_service_judges_by_the_features_of_the_fit(model):
    fit = RealFit(intercept=-0.4, confidence=0.8, context=0.5, log_count=0.3)
    judging, rng = recalibrated(model, real=fit), np.random.default_rng(0)
    for _ in range(20):
        seen = seen_by(model, rng, fit=fit)
        posterior = Posterior(judging, seen_scene(seen))
        features = real_features(model, seen)
        expected = expit(features @ [fit.confidence, fit.context, fit.log_count] + fit.intercept)
        about = doubt(judging, posterior, posterior.given_rest()[0])
        np.testing.assert_allclose(about.real, expected, atol=1e-6)


def test_the_fit_of_right_detections_is_found(model, monkeypatch):
    """About 16,000 detections determine each coefficient within .15."""
    fit = RealFit(intercept=-0.4, confidence=0.8, context=0.5, log_count=0.3)
    monkeypatch.setattr(calibrate_doubt, "detector_of", lambda _: Drawn(model, fit=fit))
    found = fit_doubt(model, [scene([0, 1], name=f"s{k}") for k in range(2000)])["real"]
    assert found.model_dump() == pytest.approx(fit.model_dump(), abs=0.15)


def test_the_fit_of_two_labels_is_found(model, monkeypatch):
    """6,000 pairs of labels determine both coefficients within .15."""
    fit = LabelFit(confidence=0.7, context=0.6)
    monkeypatch.setattr(calibrate_doubt, "detector_of", lambda _: Drawn(model, labels=fit))
    found = fit_doubt(model, [scene([0, 1], name=f"s{k}") for k in range(3000)])["labels"]
    assert found.model_dump() == pytest.approx(fit.model_dump(), abs=0.15)


def test_features_of_pairs_are_right_minus_wrong(model):
    """The first detection is a swapped bed, the second a desk with a second label."""
    classes, truth, other = np.array([0, 2]), np.array([1, 2]), np.array([1, 3])
    confidence, second = np.array([0.6, 0.9]), np.array([0.3, 0.2])
    seen = Detections(classes, confidence, truth, other, second)
    guesses = {0: Guesses(["", ""], [0, 1], [0.6, 0.3]), 1: Guesses(["", ""], [2, 3], [0.9, 0.2])}
    logit, z = label_log_odds(model, seen_scene(seen), guesses)
    expected = [[logit[1] - logit[0], z[1] - z[0]], [logit[2] - logit[3], z[2] - z[3]]]
    np.testing.assert_allclose(pair_features(model, seen), expected)


def test_an_intruder_is_a_right_detection():
    seen = Detections(*map(np.array, ([0, 1, 2], [0.9] * 3, [0, GHOST, INTRUDER], [-1] * 3, [0])))
    assert seen.right.tolist() == [True, False, True]


def test_few_scenes_leave_the_detections_as_they_are(model):
    assert fit_doubt(model, [scene([0, 1])] * 19) == {}
