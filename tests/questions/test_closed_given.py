"""The closed form with given relations against very many draws."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from app.inference.relations import Given
from app.questions.posterior import Posterior, posterior
from app.scene import Scene, SceneObject, derive_relations
from tests.questions.artifacts import larger_artifact, scene_of
from training.machines.arrays import machine_of
from training.oracle.drawn import DrawnPosterior

# Logits as wide as those of trained machines, whose standard deviation is .2 to .5. What many
# relations tell of a context that all of them share makes units of h1 depend on each other, which a
# mean field does not see: with weights as large as in the generic tests, it errs by some .03 in p.
ARTIFACT = larger_artifact("triway-wide", scale=0.12)


def with_poses():
    plain = scene_of([0, 1, 2, 3])
    places = [[1, 0, 0], [1, 0.8, 0], [1.6, 0.8, 0], [30, 0, 0]]
    return Scene(plain.objects, poses=derive_relations(places, [[0.5, 0.5, 0.5]] * 4))


SCENES = {
    "one relation": scene_of([0, 3], [(2, 0, 1)]),
    "several": scene_of([0, 1, 2, 3, 4], [(0, 0, 1), (1, 1, 2), (2, 2, 0), (3, 4, 1)], room=1),
    "instances": scene_of([2, 2, 4, 4, 7], [(0, 0, 1), (1, 1, 2), (1, 3, 4)], room=0),
    "complete": scene_of([0, 5, 6], [(0, 0, 1)], complete=True),
    "nothing holds": scene_of([0, 5, 6], [], complete=True),
    "poses": with_poses(),
    "unsure": Scene(
        (SceneObject("a", "bed", 0, 0.3), SceneObject("b", "desk", 2, 0.8)), ((1, 1, 0),)
    ),
}


def sigmoid(x):
    return 1 / (1 + np.exp(-x.astype(np.float64)))


@pytest.fixture(params=SCENES)
def scene(request):
    return SCENES[request.param]


@pytest.fixture
def pair(scene, monkeypatch):
    """In closed form, and from 2^14 draws, which are as good as exact here."""
    closed = Posterior(ARTIFACT, scene)
    monkeypatch.setattr("training.oracle.evidence.DRAWS", 1 << 14)
    return closed, DrawnPosterior(ARTIFACT, scene)


def differences(pair, ask):
    closed, drawn = (np.asarray(ask(given)) for given in pair)
    return np.abs(closed - drawn)


def absent(given):
    return np.setdiff1d(np.arange(9), given.present.classes)


def test_objects(pair):
    """Within what a mean field can do: 64 draws err by .05 and more on such scenes."""
    for ask in (lambda p: p.absent_log_odds(absent(p)), lambda p: p.log_odds_given_rest()):
        found = differences(pair, ask)
        assert found.mean() < 0.04
        assert found.max() < 0.12


def test_relations(pair):
    found = differences(pair, lambda p: sigmoid(p.relation_log_odds()))
    assert found.mean() < 0.008
    assert found.max() < 0.03


def test_placements(pair):
    anchors = np.arange(len(pair[0].present.classes))
    for way in (0, 1):
        found = differences(
            pair, lambda p, way=way: sigmoid(p.placement_log_odds(absent(p), anchors)[way])
        )
        assert found.mean() < 0.006
        assert found.max() < 0.04
    for relation in range(4):
        for outgoing in (True, False):
            found = differences(
                pair,
                lambda p, a=relation, out=outgoing: np.exp(
                    p.placed_log_p(absent(p), a, 1, outgoing=out)
                ),
            )
            assert found.max() < 0.04


def test_reasons(pair):
    """One holds what relations add as it is in the whole scene, the other lets it settle anew."""
    rows = np.arange(len(pair[0].present.classes))
    found = differences(pair, lambda p: p.reasons(rows))
    assert found.mean() < 0.035
    assert found.max() < 0.15
    closed = pair[0]
    np.testing.assert_array_equal(closed.reasons(rows[-1:]), closed.reasons(rows)[-1:])


def test_reasons_for_absent_classes(pair):
    found = differences(pair, lambda p: p.reasons_for_absent(absent(p)))
    assert found.mean() < 0.035
    assert found.max() < 0.15


def test_pairs_without_all_that_is_known_of_them(pair):
    n = len(pair[0].present.classes)
    one, other = (ends.ravel() for ends in np.meshgrid(np.arange(n), np.arange(n)))
    for way in (0, 1):
        found = differences(pair, lambda p, way=way: sigmoid(p.log_odds_apart(one, other)[way]))
        assert found.mean() < 0.008
        assert found.max() < 0.03


def with_nothing_known(artifact, scene, i, j):
    """Log-odds (A, n, n) of a scene, every relation between two classes unobserved."""
    closed = artifact.closed_form
    context = posterior(artifact, scene)._context
    given = context.given
    kept = ~(((given.i == i) & (given.j == j)) | ((given.i == j) & (given.j == i)))
    rest = Given(*(getattr(given, name)[kept] for name in ("a", "i", "j", "r", "g")))
    weights = context.classes, context.presence, context.log_counts
    return closed.relation_log_odds(closed.context(*weights, scene.room_type, rest))


def test_a_pair_is_judged_as_in_the_scene_where_nothing_is_known_of_it(scene):
    """But that the slopes of the others are held: they settle anew there."""
    judged = posterior(ARTIFACT, scene)
    given, inside = judged._context.given, judged.relation_log_odds()
    differences, left_in = [], []
    for i, j in {tuple(sorted(ends)) for ends in zip(given.i, given.j, strict=True)}:
        expected = with_nothing_known(ARTIFACT, scene, i, j)
        found = judged.log_odds_apart(np.array([i]), np.array([j]))
        for way, ends in enumerate(((i, j), (j, i))):
            truth = sigmoid(expected[:, *ends])
            differences.append(np.abs(sigmoid(found[way][:, 0]) - truth))
            left_in.append(np.abs(sigmoid(inside[:, *ends]) - truth))
    assert np.mean(differences) < 0.006
    assert np.max(differences) < 0.015
    # What the relations of a pair say of each other would be seen.
    assert np.max(left_in) > 0.018


def test_a_class_with_itself_is_taken_out_once():
    """Its relations there and back are the same units."""
    scene = scene_of([2, 2, 4], [(0, 0, 1), (1, 1, 2)])
    found = posterior(ARTIFACT, scene).log_odds_apart(np.array([0]), np.array([0]))
    np.testing.assert_array_equal(*found)
    expected = with_nothing_known(ARTIFACT, scene, 0, 0)[:, 0, 0]
    np.testing.assert_allclose(sigmoid(found[0][:, 0]), sigmoid(expected), atol=0.003)


@pytest.mark.parametrize("name", ["rbm", "gbm", "triway-seed", "triway-local", "triway-wide"])
def test_the_only_pair_known_is_judged_as_if_nothing_were(name, monkeypatch):
    """Draws of two different contexts: as near as so many of them come."""
    monkeypatch.setattr("training.oracle.evidence.DRAWS", 1 << 14)
    artifact = ARTIFACT if name == "triway-wide" else larger_artifact(name, scale=0.3)
    ends = np.array([0]), np.array([1])
    bare = posterior(artifact, scene_of([0, 3])).log_odds_apart(*ends)
    for relations_ in ([(2, 0, 1)], [(0, 1, 0), (3, 0, 1)]):
        for complete in (False, True):
            scene = scene_of([0, 3], relations_, complete=complete)
            found = posterior(artifact, scene).log_odds_apart(*ends)
            np.testing.assert_allclose(sigmoid(np.array(found)), sigmoid(np.array(bare)), atol=0.02)


def test_what_relations_imply_is_that_of_the_machine():
    machine, closed = machine_of(ARTIFACT.weights), ARTIFACT.closed_form
    rng = np.random.default_rng(0)
    for n in (2, 3, 6):
        holds = rng.random((4, n, n)) < 0.3
        a, i, j = np.nonzero(np.ones_like(holds))
        classes = np.arange(n)
        ones, zeros = np.ones(n, np.float32), np.zeros(n, np.float32)
        gate = np.ones(len(a), np.float32)
        given = Given(a, i, j, holds[a, i, j].astype(np.float32), gate)
        context = closed.context(classes, ones, zeros, None, given)
        edges = machine.edges(torch.from_numpy(classes).unsqueeze(0))
        mean = torch.from_numpy(context.x).sigmoid().unsqueeze(0)
        told = torch.from_numpy(holds.astype(np.float32)).flatten().unsqueeze(0)
        expected = machine.implied(edges, told, mean)[0].numpy()
        _, shift, apart = closed.units.said(context)
        np.testing.assert_allclose(shift.ravel(), expected, rtol=1e-4, atol=1e-4)
        expected = machine.implied(edges, told, mean, apart=True)[0].numpy()
        np.testing.assert_allclose(apart.ravel(), expected, rtol=1e-4, atol=1e-4)
