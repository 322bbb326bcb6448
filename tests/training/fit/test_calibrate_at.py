import numpy as np
import pytest
from scipy.special import expit as sigmoid

from app.model import PlaceFit
from app.scene.spatial_relations import LATERAL, STACKED
from tests.questions.artifacts import larger_artifact
from tests.training.evaluation.scenes import scene, tensors
from training.fit.calibrate_at import PlaceTerms, fit_at, fit_place

TRUE = PlaceFit(intercept=-0.4, relation=0.8, counts=0.4)
CLASSES = 20


def place(rng, fit=TRUE) -> PlaceTerms:
    """Draw the classes at a place: each is present, and then at the place, by the formula."""
    present, relation, counts = rng.normal(0, 1.5, (3, CLASSES))
    relation = -np.abs(relation)
    at = sigmoid(fit.intercept + fit.relation * relation + fit.counts * counts)
    return PlaceTerms(present, relation, counts, rng.random(CLASSES) < sigmoid(present) * at)


def places(count: int, seed: int, fit=TRUE) -> list[PlaceTerms]:
    rng = np.random.default_rng(seed)
    return [place(rng, fit) for _ in range(count)]


def test_the_entry_is_that_of_the_distribution():
    """20,000 classes. A standard error is about .04, so .2 is five of them."""
    found = fit_place([places(1000, seed=1)])
    for name in ("intercept", "relation", "counts"):
        assert getattr(found, name) == pytest.approx(getattr(TRUE, name), abs=0.2)


def test_sources_count_alike():
    """With 30 times as many places of one source, the intercept lies between those of both."""
    small, large = (
        PlaceFit(intercept=b, relation=TRUE.relation, counts=TRUE.counts) for b in (-2.0, 1.0)
    )
    assert -1.5 < fit_place([places(50, 2, small), places(1500, 3, large)]).intercept < 0.5


def test_few_true_classes_keep_the_default_entry():
    assert fit_place([]) == PlaceFit()
    terms = [one._replace(is_there=np.zeros(CLASSES, np.bool_)) for one in places(20, seed=4)]
    assert fit_place([terms]) == PlaceFit()


def test_relations_of_a_kind_share_an_entry():
    """Class 1 is always on class 0, and no scene shows left or front."""
    artifact = larger_artifact("triway")
    V = len(artifact.vocabulary)
    made = [scene([0, 1, 2 + k % 5], [(2, 1, 0)], name=f"scene {k}") for k in range(60)]
    entries = fit_at(artifact, tensors(made, V).scenes)
    assert {entries[a] for a in STACKED} == {entries[STACKED[0]]}
    assert entries[STACKED[0]] != PlaceFit()
    assert {entries[a] for a in LATERAL} == {PlaceFit()}
