"""Answers about words that the model has no class for, and whose weights it predicts."""

import numpy as np
import pytest

from app.questions.generate import generate
from app.questions.missing import missing
from app.questions.outliers import outliers
from app.questions.posterior import Posterior
from app.questions.relations import relations
from app.questions.rooms import rooms
from app.scene import RelationTable, Scene, SceneObject
from tests.questions.artifacts import LARGER, larger_artifact, lines

ALARM = lines(-1e3, -1e3, -1e3)


def open_artifact(name: str, *words: str, **changes):
    artifact = larger_artifact(name, **changes)
    return artifact.with_words([artifact.vocabulary.meaning(word) for word in words])


def objects(artifact, *labels: str) -> tuple[SceneObject, ...]:
    names = artifact.vocabulary.labels
    return tuple(SceneObject(f"{x}_{k}", x, names.index(x)) for k, x in enumerate(labels))


@pytest.fixture(params=LARGER)
def variant(request):
    return request.param


def test_a_word_that_is_listed_is_evidence(variant) -> None:
    """The log-odds of the others change as the gain of its row says."""
    artifact = open_artifact(variant, "ottoman")
    scene = Scene(objects(artifact, "bed", "ottoman"))
    posterior, weights = Posterior(artifact, scene), artifact.weights
    x = weights["c1"] + weights["W"][[0, 9]].sum(0)
    assert posterior.context.x == pytest.approx(x, abs=1e-5)
    without = Posterior(artifact, Scene(objects(artifact, "bed")))
    absent = np.array([1, 2])
    change = posterior.absent_log_odds(absent, 0.5) - without.absent_log_odds(absent, 0.5)
    reason = artifact.objects.reasons_for_absent(posterior.context, None, absent)[:, 1]
    assert change == pytest.approx(reason, abs=1e-4)
    assert np.abs(change).min() > 1e-4


def test_a_candidate_word_has_the_probability_of_its_row(variant) -> None:
    artifact = open_artifact(variant, "ottoman")
    scene = Scene(objects(artifact, "bed", "rug"))
    entry = missing(artifact, scene, candidates=[9, 1], listed_as={9: "Ottomans"}, coverage=0.5)
    named = {one["label"]: one for one in entry["missing"]}
    assert named["ottoman"]["listed_as"] == "Ottomans"
    z = Posterior(artifact, scene).absent_log_odds(np.array([9]), 0.5)[0]
    assert named["ottoman"]["log_odds"] == pytest.approx(float(z), rel=1e-4)
    assert named["ottoman"]["probability"] == pytest.approx(1 / (1 + np.exp(-float(z))), rel=1e-4)
    assert {"placements", "because"} <= named["ottoman"].keys()
    # The known classes answer as without the word.
    plain = larger_artifact(variant)
    expected = missing(plain, scene, candidates=[1], coverage=0.5)["missing"][0]
    assert named["lamp"] == expected


def test_relations_and_places_are_those_of_the_nearest_class(variant) -> None:
    artifact = open_artifact(variant, "couch")
    word, sofa = 9, 4
    assert artifact.vocabulary.stand_in[word] == sofa
    for others in (("lamp", "rug"), ("desk", "vase")):
        scene = Scene(objects(artifact, *others))
        anchors = np.array([0, 1])
        posterior = Posterior(artifact, scene)
        units, W = artifact.relation_units, artifact.weights["W"].copy()
        # With the same effect on the hidden units, the word has the relations of a sofa.
        W[sofa] = W[word]
        units._W = W
        both = [
            units.placement_log_odds(posterior.context, np.array([k]), anchors)
            for k in (word, sofa)
        ]
        for a, b in zip(*both, strict=True):
            assert a == pytest.approx(b, abs=1e-4)
    scene = Scene(objects(artifact, "couch", "rug"), RelationTable.stated([(3, 0, 1)]))
    answer = relations(artifact, scene, top_k=50)
    assert {one["subject"] for one in answer["relations"]} >= {"couch_0"}


def test_a_word_never_is_an_outlier(variant) -> None:
    """Not even where every known object is, or where the request states a threshold."""
    artifact = open_artifact(variant, "ottoman", outlier_lines=ALARM)
    scene = Scene(objects(artifact, "bed", "ottoman", "lamp"))
    for options in ({}, {"threshold": 0.0}, {"sensitivity": "high"}):
        answer = outliers(artifact, scene, **options)
        flags = {one["label"]: one["is_outlier"] for one in answer["outliers"]}
        assert flags == {"bed": True, "lamp": True, "ottoman": False}
        (warning,) = answer["warnings"]
        assert (warning.code, warning.objects) == ("not-judged", ["ottoman_1"])


def test_a_word_tells_the_room_type() -> None:
    artifact = open_artifact("triway", "ottoman")
    scene = Scene(objects(artifact, "bed", "ottoman"))
    p = {one["room_type"]: one["probability"] for one in rooms(artifact, scene)["room_types"]}
    assert sum(p.values()) == pytest.approx(1, abs=1e-5)
    without = rooms(artifact, Scene(objects(artifact, "bed")))["room_types"]
    assert p != {one["room_type"]: one["probability"] for one in without}


def test_words_are_drawn_only_as_evidence(variant) -> None:
    artifact = open_artifact(variant, "ottoman", "mug")
    scene = Scene(objects(artifact, "bed", "ottoman", "mug"))
    answer = generate(artifact, scene, count=3, seed=1, steps=5)
    for drawn in answer["scenes"]:
        assert {"bed", "ottoman", "mug"} <= {*drawn["objects"]}
        assert np.isfinite(drawn["log_score"])
    assert generate(artifact, scene, count=3, seed=1, steps=5) == answer
