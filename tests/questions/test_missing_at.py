"""The probability of a missing object at the place that a request names."""

from __future__ import annotations

import math
from importlib import import_module

import numpy as np
import pytest

from app.questions.placements import Place, place_log_p
from app.questions.posterior import Posterior
from app.registry.description import PlaceFit
from app.scene.relations import CANONICAL, OPPOSITES
from tests.questions.answers import missing
from tests.questions.artifacts import LABELS, STRUCTURE, larger_artifact, scene_of

module = import_module("app.questions.missing")  # the package has a function of this name
NAMES = ["rbm", "triway", "triway-states"]
FITS = tuple(
    PlaceFit(relation=0.3 + 0.2 * a, counts=0.1 * a, intercept=0.5 - a, slope=0.6 + 0.1 * a)
    for a in range(5)
)
STATED = [(2, 1, 0), (0, 0, 3)]


def by_hand(artifact, scene, name, anchor, coverage):
    """A dictionary from the label of every unlisted class to its probability."""
    relation = CANONICAL.index(name if name in CANONICAL else OPPOSITES_OF[name])
    fit, is_subject = artifact.calibration.at[relation], name in CANONICAL
    listed = {thing.label for thing in scene.objects}
    classes = [
        k for k, label in enumerate(LABELS) if label not in STRUCTURE and label not in listed
    ]
    posterior = Posterior(artifact, scene)
    z = posterior.absent_log_odds(np.array(classes), coverage)
    place = Place(relation, anchor, is_subject)
    log_p = place_log_p(posterior, np.array(classes), place)
    of_anchor = scene.objects[anchor].class_index
    ratio = artifact.places.log_ratio(relation, of_anchor, outgoing=is_subject)
    probabilities = {}
    for k, odds, p in zip(classes, z.tolist(), log_p.tolist(), strict=True):
        value = odds + fit.relation * p + fit.counts * float(ratio[k])
        probabilities[LABELS[k]] = 1 / (1 + math.exp(-(fit.intercept + fit.slope * value)))
    return probabilities


OPPOSITES_OF = {opposite: name for name, opposite in OPPOSITES.items()}


@pytest.mark.parametrize("machine", NAMES)
@pytest.mark.parametrize("name", [*OPPOSITES, *OPPOSITES_OF])
@pytest.mark.parametrize("block", [32, 2])
def test_all_classes_have_the_probability_of_the_formula(monkeypatch, machine, name, block):
    monkeypatch.setattr(module, "_BLOCK", block)
    artifact, scene = larger_artifact(machine, at=FITS), scene_of([0, 1, 2, 3], STATED)
    expected = by_hand(artifact, scene, name, 2, 0.5)
    answer = {entry.label: entry for entry in missing(artifact, scene, at=(name, 2), top_k=9)}
    assert answer.keys() == expected.keys()
    for label, entry in answer.items():
        assert entry.probability == pytest.approx(expected[label], rel=1e-4)
    assert [*answer] == sorted(expected, key=expected.__getitem__, reverse=True)


def count_scored(monkeypatch):
    """Return a list that gets the classes whose relation is scored, in blocks of a single class."""
    scored = []

    def counted(posterior, candidates, place):
        scored.extend(candidates.tolist())
        return place_log_p(posterior, candidates, place)

    monkeypatch.setattr(module, "_BLOCK", 1)
    monkeypatch.setattr(module, "place_log_p", counted)
    return scored


@pytest.mark.parametrize("machine", NAMES)
@pytest.mark.parametrize("name", ["on-top", "under", "left", "contains"])
@pytest.mark.parametrize("top_k", [1, 2, 4])
def test_an_early_stop_leaves_the_likeliest_classes_as_they_are(monkeypatch, machine, name, top_k):
    """With blocks of a single class, the function scores as few classes as possible."""
    artifact, scene = larger_artifact(machine, at=FITS), scene_of([0, 2], None)
    every = missing(artifact, scene, at=(name, 1), top_k=9, details=False)
    scored = count_scored(monkeypatch)
    some = missing(artifact, scene, at=(name, 1), top_k=top_k, details=False)
    assert [entry.label for entry in some] == [entry.label for entry in every[:top_k]]
    for entry, other in zip(some, every, strict=False):
        assert entry[1:] == pytest.approx(other[1:], rel=1e-5)
    assert top_k <= len(scored) == len(set(scored)) <= len(every)
