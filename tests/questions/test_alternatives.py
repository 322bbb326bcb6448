"""Objects with several labels: the decision, its answer, and the scene that it makes."""

import math

import numpy as np
import pytest

from app import questions
from app.errors import InvalidRequestError, UnknownLabelsError
from app.model import LabelFit
from app.questions.alternatives import Guesses, label_probabilities
from app.questions.names import LookUps, Unknown
from app.questions.posterior import Posterior
from app.questions.reading import Limits, read_scene
from app.scene import Scene
from scene_client.schemas import MissingRequest
from tests.questions.artifacts import LABELS, LARGER, larger_artifact, scene_of

FIT = LabelFit(confidence=1.7, context=0.6)


@pytest.fixture(params=LARGER)
def artifact(request):
    return larger_artifact(request.param, labels=FIT)


def given_rest(artifact, classes: list[int], target: int) -> float:
    """The log-odds of a listed class given the others, which are certain."""
    posterior = Posterior(artifact, scene_of([*classes, target]))
    return float(posterior.given_rest()[0][posterior.present.classes.tolist().index(target)])


def test_the_probabilities_follow_the_formula(artifact):
    others, guesses = [0, 2, 5], Guesses(["a", "b", "c"], [1, 3, 6], [0.5, 0.3, 0.1])
    p = label_probabilities(artifact, scene_of([*others, 1]), {3: guesses})[3]
    logits = np.array(
        [
            1.7 * math.log(c / (1 - c)) + 0.6 * given_rest(artifact, others, k)
            for k, c in zip(guesses.classes, guesses.confidence, strict=True)
        ]
    )
    weights = np.exp(logits - logits.max())
    assert p == pytest.approx(weights / weights.sum(), abs=2e-4)


def test_confidences_above_one_are_scaled():
    artifact = larger_artifact("triway", labels=LabelFit(confidence=1.0, context=0.0))
    p = label_probabilities(artifact, scene_of([0, 1]), {1: Guesses("ab", [1, 3], [1.0, 0.25])})[1]
    odds = (0.8 / 0.2) / (0.2 / 0.8)
    assert p[0] / p[1] == pytest.approx(odds, rel=1e-4)


def test_another_object_of_the_class_is_no_evidence(artifact):
    """The class of a label is left out of its own context, as in the log-odds given the rest."""
    one, two = Guesses("ab", [1, 3], [0.5, 0.4]), scene_of([0, 2, 1, 1])
    alone = label_probabilities(artifact, scene_of([0, 2, 1]), {2: one})[2]
    doubled = label_probabilities(artifact, two, {2: one})[2]
    z = [given_rest(artifact, [0, 2], 1), given_rest(artifact, [0, 1, 2], 3)]
    ratio = math.log(doubled[0] / doubled[1]) - math.log(alone[0] / alone[1])
    expected = 0.6 * (
        z[0] - z[1] - given_rest(artifact, [0, 2], 1) + given_rest(artifact, [0, 2], 3)
    )
    assert ratio == pytest.approx(expected, abs=2e-3)


def read(objects: list[object], **fields: object):
    artifact = larger_artifact("triway", labels=FIT)
    request = MissingRequest.model_validate({"objects": objects, **fields})
    vocabulary = artifact.vocabulary
    unknown = Unknown(vocabulary, request.unknown_labels, LookUps())

    def decide(words: object, scene: Scene, guesses: object):
        return label_probabilities(artifact, scene, guesses)

    return read_scene(request, vocabulary, Limits(), unknown, decide=decide)


def labelled(label: str, confidence: float, *others: tuple[str, float], **fields: object):
    alternatives = [{"label": name, "confidence": c} for name, c in others]
    return {"label": label, "confidence": confidence, "alternatives": alternatives, **fields}


def test_the_scene_has_the_likeliest_label():
    reading = read(["bed", labelled("lamp", 0.2, ("chair", 0.7), id="x")])
    (decision,) = reading.resolved
    labels, p = decision.labels, decision.probabilities
    thing = reading.scene.objects[1]
    assert (decision.object, set(labels)) == ("x", {"lamp", "chair"})
    assert (thing.label, thing.class_index) == (labels[0], LABELS.index(labels[0]))
    assert sum(p) == pytest.approx(1)
    assert p == sorted(p, reverse=True)
    assert thing.confidence == pytest.approx(0.9 * p[0])


def test_an_object_without_alternatives_is_not_resolved():
    reading = read(["bed", {"label": "lamp", "confidence": 0.3}])
    assert not reading.resolved
    assert reading.scene.objects[1].confidence == 0.3


def test_unknown_alternatives_are_left_out_and_an_unknown_label_is_replaced():
    reading = read(
        ["bed", labelled("blurb", 0.6, ("lamp", 0.3)), labelled("desk", 0.6, ("blurb", 0.3))],
        unknown_labels="ignore",
    )
    assert [thing.label for thing in reading.scene.objects] == ["bed", "lamp", "desk"]
    assert not reading.resolved
    assert not reading.unknown.ignored
    reading = read(["bed", labelled("blurb", 0.6, ("blarb", 0.3), id="x")], unknown_labels="ignore")
    assert reading.unknown.ignored == ["x"]
    assert len(reading.scene.objects) == 1


def test_labels_of_one_class_count_together():
    reading = read(["bed", labelled("lamp", 0.3, ("Lamps", 0.3), ("chair", 0.35))])
    (decision,) = reading.resolved
    assert sorted(decision.labels) == ["chair", "lamp"]
    reading = read(["bed", labelled("lamp", 0.3, ("Lamps", 0.3))])
    assert reading.scene.objects[1].confidence == pytest.approx(0.6)


def test_the_size_of_a_box_is_that_of_the_chosen_label():
    """Relations of boxes are derived after the decision."""
    box = {"position": [1.0, 0.0, 0.5], "size": [0.4, 0.4, 0.4]}
    reading = read(
        [{"label": "desk", "position": [1, 0, 0.2], "size": [1, 1, 0.2]},
         labelled("lamp", 0.5, ("vase", 0.45), **box)]
    )  # fmt: skip
    assert reading.observed
    assert reading.scene.objects[1].position is not None


def test_the_confidence_is_that_of_the_known_label():
    reading = read(["bed", labelled("blurb", 0.9, ("lamp", 0.05))], unknown_labels="ignore")
    assert reading.scene.objects[1].confidence == pytest.approx(0.05)


@pytest.mark.parametrize("treatment", ["error", "nearest", "nearest-or-ignore"])
def test_an_unknown_alternative_costs_no_answer(treatment):
    reading = read(["bed", labelled("lamp", 0.6, ("xyzzy", 0.3))], unknown_labels=treatment)
    assert reading.scene.objects[1].label == "lamp"


def test_an_object_without_a_known_label_is_an_error():
    with pytest.raises(UnknownLabelsError) as raised:
        read(["bed", labelled("blurb", 0.6, ("xyzzy", 0.3))])
    places = [one.location for one in raised.value.located]
    assert places == [("objects", 1, "label"), ("objects", 1, "alternatives", 0, "label")]


def test_too_many_labels_are_refused():
    many = [labelled("lamp", 0.5, *[("chair", 0.1)] * 8) for _ in range(57)]
    with pytest.raises(InvalidRequestError, match="errors"):
        read(many)


@pytest.mark.parametrize("confidence", [1e-320, 1e-46, 1e-10])
def test_a_tiny_confidence_is_almost_no_object(artifact, confidence):
    """float32 cannot divide by it."""
    objects = ["bed", {"label": "lamp", "confidence": confidence}, "desk"]
    request = MissingRequest.model_validate({"objects": objects})
    reading = read_scene(request, artifact.vocabulary, Limits())
    entries, without = (
        questions.missing(artifact, scene, top_k=1)["missing"]
        for scene in (reading.scene, scene_of([0, 2]))
    )
    assert entries[0]["probability"] == pytest.approx(without[0]["probability"], abs=1e-3)
