"""Answers in closed form against the same answers from very many draws of the context."""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np
import pytest
import torch

from app.inference.posterior import ClosedForm
from app.registry import Artifact
from app.registry.description import EvidenceWeights
from app.scene import RELATIONS, Scene, SceneObject, derive_relations
from tests.questions.answers import missing, outliers, relations
from tests.questions.artifacts import LABELS, LARGER, larger_artifact, scene_of
from training.fit.oracle.drawn import DrawnPosterior
from training.machines import MachineSpec, build
from training.machines.arrays import weights_of

pytestmark = pytest.mark.usefixtures("the_likeliest_is_expected")

Numbers = dict[Any, float]


def with_poses(*classes: int) -> Scene:
    """Three things near each other and one far away; what holds of them is derived, not stated."""
    places = [[1, 0, 0], [1, 0.8, 0], [1.6, 0.8, 0], [30, 0, 0]]
    poses = derive_relations(places, [[0.5, 0.5, 0.5]] * 4)
    triples = tuple((int(a), int(i), int(j)) for a, i, j in np.argwhere(poses.holds))
    return Scene(scene_of(list(classes)).objects, triples, poses=poses)


UNSURE = (SceneObject("a", "bed", 0, 0.3), SceneObject("b", "desk", 2, 0.8))
SCENES = {
    "one thing": scene_of([0]),
    "bare": scene_of([0, 3, 5, 6], room=1),
    "two instances": scene_of([2, 2, 2, 4, 4, 7], room=0),
    "unsure": Scene(UNSURE),
    "one relation": scene_of([0, 3, 5], [(2, 0, 1)]),
    "several": scene_of([0, 1, 2, 3, 4], [(0, 0, 1), (1, 1, 2), (2, 2, 0), (3, 4, 1)], room=1),
    "of instances": scene_of([2, 2, 4, 4, 7], [(0, 0, 1), (1, 1, 2), (1, 3, 4)], room=0),
    "complete": scene_of([0, 5, 6], [(0, 0, 1)], complete=True),
    "nothing holds": scene_of([0, 5, 6], [], complete=True),
    "poses": with_poses(0, 1, 2, 3),
    "one of the unsure": Scene(UNSURE, ((1, 1, 0),)),
}
BARE = tuple(SCENES)[:4]
# Nats of log-odds and of reasons; probabilities of relations and of placements, which have fewer
# draws. Without relations objects are exact. What many relations tell of a context moves it away
# from the factorial one, and a second layer is held at what the objects say.
CASES = [("triway-wide", 0.7, scene, (1e-3, 1e-3, 0.01, 0.2)) for scene in BARE]
CASES += [
    ("triway-wide", 0.12, scene, (0.04, 0.04, 0.02, 0.01)) for scene in SCENES if scene not in BARE
]
# One relation between doubtful objects moves little, and by the presence of both.
CASES += [("triway-wide", 0.12, "one of the unsure", (1e-3, 1e-3, 1e-3, 1e-3))]
for variant in ("rbm-wide", "gbm-wide", "triway-deep"):
    CASES += [(variant, 0.25, scene, (1e-3, 0.01, 0.01, 0.02)) for scene in BARE[1:3]]
    CASES += [
        (variant, 0.25, "one relation", (0.15, 0.25, 0.02, 0.02)),
        (variant, 0.25, "poses", (0.4, 0.4, 0.12, 0.12)),
    ]


def about_objects(artifact: Artifact, scene: Scene) -> Numbers:
    """Log-odds of each class that is not there, and of each thing that is."""
    absent = {one.label: one.log_odds for one in missing(artifact, scene, top_k=9)}
    return absent | {one.object: one.log_odds for one in outliers(artifact, scene).outliers}


def reasons(artifact: Artifact, scene: Scene) -> Numbers:
    """What some objects add to these."""
    found = [(one.label, one.because) for one in missing(artifact, scene, top_k=9)]
    for threshold in (0.0, 1.0):
        judged = outliers(artifact, scene, threshold=threshold).outliers
        found += [(one.object, one.because) for one in judged]
    return {(of, one.object): one.log_odds_change for of, because in found for one in because}


def about_relations(artifact: Artifact, scene: Scene) -> Numbers:
    """Of every pair, and as they were stated."""
    listed, _ = relations(artifact, scene, top_k=4096)
    misplaced = outliers(artifact, scene).misplaced
    answers = [("listed", one) for one in listed] + [("misplaced", one) for one in misplaced]
    return {(kind, one.subject, one.relation, one.object): one.probability for kind, one in answers}


def disagreements(artifact: Artifact, scene: Scene) -> Numbers:
    """Of every pair without all that is known of it."""
    _, found = relations(artifact, scene, top_k=4096)
    return {
        (of, one.subject, one.object, one.expected if of == "expected" else one.observed): p
        for one in found
        for of, p in (("expected", one.probability), ("observed", one.observed_probability))
    }


def placements(artifact: Artifact, scene: Scene) -> Numbers:
    return {
        (one.label, place.relation, place.object): place.probability
        for one in missing(artifact, scene, top_k=9)
        for place in one.placements
    }


def places(artifact: Artifact, scene: Scene) -> Numbers:
    """Of each class to be there and in that place."""
    return {
        (relation, one.label): one.probability
        for relation in RELATIONS
        for one in missing(artifact, scene, at=(relation, 0), top_k=9)
    }


def differences(found: Numbers, expected: Numbers) -> np.ndarray:
    """Where only the first few are listed, of those in both lists."""
    both = found.keys() & expected.keys()
    assert 2 * len(both) >= len(found)
    return np.array([found[key] - expected[key] for key in both])


@pytest.mark.parametrize(("name", "scale", "of", "bounds"), CASES)
def test_answers_are_those_of_very_many_draws(
    name: str,
    scale: float,
    of: str,
    bounds: tuple[float, ...],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr("training.fit.oracle.evidence.DRAWS", 1 << 13)
    scene, closed = SCENES[of], larger_artifact(name, scale=scale)
    assert closed.oracle is None
    drawn = dataclasses.replace(closed, oracle=DrawnPosterior)
    log_odds, changes, probability, placed = bounds
    for ask, bound in (
        (about_objects, log_odds),
        (reasons, changes),
        (about_relations, probability),
        (disagreements, probability),
        (placements, placed),
        (places, placed),
    ):
        found = differences(ask(closed, scene), ask(drawn, scene))
        if len(found):
            assert np.abs(found).max() < bound, ask.__name__
            assert np.abs(found).mean() < bound / 2, ask.__name__


# The seed form draws its answers: here from two different contexts.
@pytest.mark.parametrize("name", [name for name, spec in LARGER.items() if spec.is_local])
def test_placements_are_the_relations_of_a_candidate_once_it_is_there(name: str) -> None:
    artifact, scene = larger_artifact(name, scale=0.3), scene_of([0, 3, 3, 5])
    for answer in missing(artifact, scene, top_k=9):
        label = answer.label
        thing = SceneObject("candidate", label, LABELS.index(label))
        there = dataclasses.replace(scene, objects=(*scene.objects, thing))
        listed, _ = relations(artifact, there, top_k=4096, include_opposites=True)
        p = {(one.subject, one.relation, one.object): one.probability for one in listed}
        for place in answer.placements:
            assert place.probability == pytest.approx(p[4, place.relation, place.object], abs=0.02)


def sharing(name: str, kind: str, *, objects: float = 1.0, of_relations: float = 1.0) -> Artifact:
    weights = {f"{kind}_on_objects": objects, f"{kind}_on_relations": of_relations}
    return larger_artifact(name, scale=0.3, evidence=EvidenceWeights(**weights))


KINDS = {
    "relations": scene_of([0, 1, 2, 3], [(2, 1, 0), (0, 2, 3), (1, 0, 3)]),
    "poses": with_poses(0, 1, 2, 3),
}


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("name", LARGER)
def test_given_relations_act_by_their_weight(name: str, kind: str) -> None:
    """On objects by one, on relations by another, and none of the other kind of evidence."""
    scene, other = KINDS[kind], "poses" if kind == "relations" else "relations"
    full, none = sharing(name, kind), sharing(name, kind, objects=0.0)
    bare = about_objects(full, scene_of([0, 1, 2, 3]))
    assert np.abs(differences(about_objects(none, scene), bare)).max() < 1e-3
    assert np.abs(differences(about_objects(full, scene), bare)).max() > 1e-3
    elsewhere = sharing(name, other, objects=0.3, of_relations=0.3)
    objects, of_relations = (
        sharing(name, kind, **weight) for weight in ({"objects": 0.3}, {"of_relations": 0.3})
    )
    for ask, same, changed in (
        (about_objects, of_relations, objects),
        (about_relations, objects, of_relations),
    ):
        assert ask(full, scene) == ask(same, scene) == ask(elsewhere, scene)
        assert np.abs(differences(ask(full, scene), ask(changed, scene))).max() > 1e-3


@pytest.mark.parametrize("weight", [0.0, 0.3, 0.7])
@pytest.mark.parametrize("kind", KINDS)
def test_weighted_answers_are_those_of_draws(
    kind: str, weight: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The closed form scales the pull of its mean field, draws the likelihood of relations."""
    monkeypatch.setattr("training.fit.oracle.evidence.DRAWS", 1 << 13)
    weights = {f"{kind}_on_objects": weight, f"{kind}_on_relations": weight}
    closed = larger_artifact("triway-wide", scale=0.12, evidence=EvidenceWeights(**weights))
    drawn = dataclasses.replace(closed, oracle=DrawnPosterior)
    for ask, bound in ((about_objects, 0.12), (about_relations, 0.03)):
        found = differences(ask(closed, KINDS[kind]), ask(drawn, KINDS[kind]))
        assert np.abs(found).max() < bound


@pytest.mark.parametrize("largest", [70.0, 1.0])
def test_weights_too_large_for_products_have_no_closed_form(largest: float) -> None:
    """Nor has the seed form."""
    machine = build(MachineSpec("triway", V=5, A=2, H1=70, K=2, form="local"))
    with torch.no_grad():
        machine.W[1, 2] = largest
    assert ClosedForm.supports(weights_of(machine)) == (largest < 64)
    assert not ClosedForm.supports(weights_of(machine.double()))
    seed = weights_of(build(MachineSpec("rbm", V=5, A=2, H1=70)))
    assert not ClosedForm.supports(seed)
    with pytest.raises(ValueError, match="local form"):
        ClosedForm(seed)
