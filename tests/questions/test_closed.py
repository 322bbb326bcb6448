"""The closed form against the same posterior from very many draws."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
import torch

from app.inference.posterior import ClosedForm
from app.questions.posterior import Posterior, posterior
from app.scene import Scene, SceneObject
from tests.questions.artifacts import larger_artifact, scene_of
from training.machines import MachineSpec, build
from training.machines.arrays import weights_of
from training.oracle.drawn import DrawnPosterior

ARTIFACT = larger_artifact("triway-wide")
SCENES = [
    scene_of([0]),
    scene_of([0, 3, 5]),
    scene_of([0, 1, 2, 3, 4, 5, 6, 7], room=1),
    scene_of([2, 2, 2, 4, 4, 7], room=0),
    Scene((SceneObject("a", "bed", 0, 0.3), SceneObject("b", "desk", 2, 0.8))),
]
# Of 2^15 draws, a Sobol sequence at that: far below. The rest is for what is not normal.
TOLERANCE = 0.004


def sigmoid(x):
    return 1 / (1 + np.exp(-x.astype(np.float64)))


@pytest.fixture(params=range(len(SCENES)))
def scene(request):
    return SCENES[request.param]


@pytest.fixture
def pair(scene, monkeypatch):
    monkeypatch.setattr("training.oracle.evidence.DRAWS", 1 << 15)
    closed = Posterior(ARTIFACT, scene)
    return closed, DrawnPosterior(ARTIFACT, scene)


def test_reasons_are_exact(pair):
    closed, drawn = pair
    for rows in (np.arange(len(closed.present.classes)), np.array([0])):
        np.testing.assert_allclose(closed.reasons(rows), drawn.reasons(rows), rtol=1e-4, atol=1e-3)


def test_reasons_for_absent_classes_are_exact(pair):
    closed, drawn = pair
    absent = np.setdiff1d(np.arange(9), closed.present.classes)
    found = closed.reasons_for_absent(absent)
    np.testing.assert_allclose(found, drawn.reasons_for_absent(absent), rtol=1e-4, atol=1e-3)
    np.testing.assert_array_equal(closed.reasons_for_absent(absent[-1:]), found[-1:])


def test_relations(pair):
    closed, drawn = pair
    found, expected = sigmoid(closed.relation_log_odds()), sigmoid(drawn.relation_log_odds())
    np.testing.assert_allclose(found, expected, atol=TOLERANCE)


def test_placements_are_the_relations_of_a_candidate_once_it_is_there(pair, scene):
    closed, _ = pair
    n = len(closed.present.classes)
    candidates = np.setdiff1d(np.arange(9), closed.present.classes)
    forward, backward = closed.placement_log_odds(candidates, np.arange(n))
    for k, candidate in enumerate(candidates):
        thing = SceneObject("candidate", "x", int(candidate))
        there = posterior(ARTIFACT, dataclasses.replace(scene, objects=(*scene.objects, thing)))
        expected = there.relation_log_odds()
        place = int(np.searchsorted(closed.present.classes, candidate))
        others = np.delete(np.arange(n + 1), place)
        np.testing.assert_allclose(forward[k], expected[:, place, others], rtol=1e-4, atol=1e-4)
        np.testing.assert_allclose(backward[k], expected[:, others, place], rtol=1e-4, atol=1e-4)


def test_one_placement_of_many_candidates(pair):
    closed, _ = pair
    candidates = np.setdiff1d(np.arange(9), closed.present.classes)
    anchors = np.arange(len(closed.present.classes))
    both = closed.placement_log_odds(candidates, anchors)
    for relation in range(4):
        for outgoing, log_odds in zip((True, False), both, strict=True):
            log_p = closed.placed_log_p(candidates, relation, anchors[-1], outgoing=outgoing)
            expected = sigmoid(log_odds[:, relation, -1])
            np.testing.assert_allclose(np.exp(log_p), expected, rtol=1e-4, atol=1e-6)


def test_the_seed_form_has_no_closed_form():
    weights = weights_of(build(MachineSpec("rbm", V=5, A=2, H1=70)))
    assert not ClosedForm.fits(weights)
    with pytest.raises(ValueError, match="local form"):
        ClosedForm(weights)


@pytest.mark.parametrize("largest", [70.0, 1.0])
def test_weights_too_large_for_products_have_none_either(largest):
    machine = build(MachineSpec("triway", V=5, A=2, H1=70, K=2, form="local"))
    with torch.no_grad():
        machine.W[1, 2] = largest
    assert ClosedForm.fits(weights_of(machine)) == (largest < 64)
    assert not ClosedForm.fits(weights_of(machine.double()))
