"""Answers in closed form, compared with the same answers from very many draws of the context."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch

from app.inference.posterior import ClosedForm
from app.registry import Artifact
from app.registry.description import EvidenceWeights
from app.scene import RELATIONS, Scene, SceneObject, derive_relations
from tests.questions.answers import disagreements, misplaced, missing, outliers, relations
from tests.questions.artifacts import LARGER, larger_artifact, scene_of
from training.fit.oracle.drawn import DrawnPosterior
from training.machines import MachineSpec, build
from training.machines.arrays import weights_of

pytestmark = pytest.mark.usefixtures("without_minimums")

Numbers = dict[Any, float]


def with_poses(*classes: int) -> Scene:
    """Three objects side by side and a distant one. Their poses give their relations."""
    positions = [[1, 0, 0], [1, 0.8, 0], [1.6, 0.8, 0], [30, 0, 0]]
    poses = derive_relations(positions, [[0.5, 0.5, 0.5]] * 4)
    triples = tuple((int(a), int(i), int(j)) for a, i, j in np.argwhere(poses.holds))
    return Scene(scene_of(list(classes)).objects, triples, poses=poses)


UNSURE = (SceneObject("a", "bed", 0, 0.3), SceneObject("b", "desk", 2, 0.8))
SCENES = {
    "one object": scene_of([0]),
    "bare": scene_of([0, 3, 5, 6], room=1),
    "instances": scene_of([2, 2, 2, 4, 4, 7], room=0),
    "unsure": Scene(UNSURE),
    "one relation": scene_of([0, 3, 5], [(2, 0, 1)]),
    "several": scene_of([0, 1, 2, 3, 4], [(0, 0, 1), (1, 1, 2), (2, 2, 0), (3, 4, 1)], room=1),
    "of instances": scene_of([2, 2, 4, 4, 7], [(0, 0, 1), (1, 1, 2), (1, 3, 4)], room=0),
    "complete": scene_of([0, 5, 6], [(0, 0, 1)], complete=True),
    "no relation holds": scene_of([0, 5, 6], [], complete=True),
    "poses": with_poses(0, 1, 2, 3),
    "relation of unsure": Scene(UNSURE, ((1, 1, 0),)),
}
BARE = tuple(SCENES)[:4]
# Tolerances of log-odds, of reasons, and of the probabilities of relations and of placements, which
# have fewer draws. Without relations, the log-odds of objects are exact. Many relations move the
# context away from the factorial one, and the closed form holds a second layer at its mean given
# the objects.
CASES = [("triway-wide", 0.7, scene, (1e-3, 1e-3, 0.01, 0.2)) for scene in BARE]
CASES += [
    ("triway-wide", 0.12, scene, (0.04, 0.04, 0.02, 0.01)) for scene in SCENES if scene not in BARE
]
# A relation between doubtful objects has a small effect, by the presence of both.
CASES += [("triway-wide", 0.12, "relation of unsure", (1e-3, 1e-3, 1e-3, 1e-3))]
for variant in ("rbm-wide", "gbm-wide", "triway-deep"):
    CASES += [(variant, 0.25, scene, (1e-3, 0.01, 0.01, 0.02)) for scene in BARE[1:3]]
    CASES += [
        (variant, 0.25, "one relation", (0.15, 0.25, 0.02, 0.02)),
        (variant, 0.25, "poses", (0.4, 0.4, 0.12, 0.12)),
    ]


@pytest.fixture
def drawn(monkeypatch: pytest.MonkeyPatch) -> Any:
    """A function that makes an artifact answer by very many draws."""
    monkeypatch.setattr("training.fit.oracle.evidence.DRAWS", 1 << 13)
    return lambda artifact: replace(artifact, oracle=DrawnPosterior)


def of_objects(artifact: Artifact, scene: Scene) -> Numbers:
    """The log-odds of each absent class and of each object."""
    absent = {entry.label: entry.log_odds for entry in missing(artifact, scene, top_k=9)}
    judged = outliers(artifact, scene).outliers
    return absent | {entry.object: entry.log_odds for entry in judged}


def of_reasons(artifact: Artifact, scene: Scene) -> Numbers:
    causes = [(entry.label, entry.because) for entry in missing(artifact, scene, top_k=9)]
    for threshold in (0.0, 1.0):
        judged = outliers(artifact, scene, threshold=threshold).outliers
        causes += [(entry.object, entry.because) for entry in judged]
    return {(of, one.object): one.log_odds_change for of, because in causes for one in because}


def of_relations(artifact: Artifact, scene: Scene) -> Numbers:
    """The probabilities of all relations, and those of the stated relations to be false."""
    return {
        (kind, *entry[:3]): entry.probability
        for kind, entries in enumerate(
            (relations(artifact, scene, top_k=4096), misplaced(artifact, scene))
        )
        for entry in entries
    }


def of_disagreements(artifact: Artifact, scene: Scene) -> Numbers:
    return {
        (d.subject, d.object, relation): p
        for d in disagreements(artifact, scene, top_k=4096)
        for relation, p in ((d.expected, d.probability), (d.observed, d.observed_probability))
    }


def of_placements(artifact: Artifact, scene: Scene) -> Numbers:
    return {
        (entry.label, place.relation, place.object): place.probability
        for entry in missing(artifact, scene, top_k=9)
        for place in entry.placements
    }


def of_places(artifact: Artifact, scene: Scene) -> Numbers:
    """The probability of each class to be present in a place."""
    return {
        (relation, entry.label): entry.probability
        for relation in RELATIONS
        for entry in missing(artifact, scene, at=(relation, 0), top_k=9)
    }


def differences(values: Numbers, others: Numbers) -> np.ndarray:
    """The absolute differences of the entries in both answers. Some lists have a maximum length."""
    both = values.keys() & others.keys()
    assert 2 * len(both) >= len(values)
    return np.abs([values[key] - others[key] for key in both])


@pytest.mark.parametrize(("name", "scale", "scene", "bounds"), CASES)
def test_answers_equal_those_of_very_many_draws(
    name: str, scale: float, scene: str, bounds: tuple[float, ...], drawn: Any
) -> None:
    artifact = larger_artifact(name, scale=scale)
    assert artifact.oracle is None
    log_odds, changes, probability, placed = bounds
    for numbers, bound in (
        (of_objects, log_odds),
        (of_reasons, changes),
        (of_relations, probability),
        (of_disagreements, probability),
        (of_placements, placed),
        (of_places, placed),
    ):
        error = differences(*(numbers(one, SCENES[scene]) for one in (artifact, drawn(artifact))))
        if len(error):
            assert error.max() < bound, numbers.__name__
            assert error.mean() < bound / 2, numbers.__name__


KINDS = {
    "relations": scene_of([0, 1, 2, 3], [(2, 1, 0), (0, 2, 3), (1, 0, 3)]),
    "poses": with_poses(0, 1, 2, 3),
}


def weighted(name: str, kind: str, objects: float, on_relations: float, scale: float) -> Artifact:
    weights = {f"{kind}_on_objects": objects, f"{kind}_on_relations": on_relations}
    return larger_artifact(name, scale=scale, evidence=EvidenceWeights(**weights))


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("name", LARGER)
def test_observed_relations_act_by_their_weight(name: str, kind: str) -> None:
    """One weight acts on objects, and one on relations. Poses have weights of their own."""
    scene, other = KINDS[kind], "poses" if kind == "relations" else "relations"
    full, none, objects, on_relations = (
        weighted(name, kind, *weights, 0.3) for weights in ((1, 1), (0, 1), (0.3, 1), (1, 0.3))
    )
    elsewhere = weighted(name, other, 0.3, 0.3, 0.3)
    bare = of_objects(full, scene_of([0, 1, 2, 3]))
    assert differences(of_objects(none, scene), bare).max() < 1e-3
    assert differences(of_objects(full, scene), bare).max() > 1e-3
    for numbers, same, changed in (
        (of_objects, on_relations, objects),
        (of_relations, objects, on_relations),
    ):
        assert numbers(full, scene) == numbers(same, scene) == numbers(elsewhere, scene)
        assert differences(numbers(full, scene), numbers(changed, scene)).max() > 1e-3


@pytest.mark.parametrize("weight", [0.0, 0.3, 0.7])
@pytest.mark.parametrize("kind", KINDS)
def test_weighted_answers_equal_those_of_draws(kind: str, weight: float, drawn: Any) -> None:
    """The closed form scales the effect on its mean field, and draws scale the likelihood."""
    artifact = weighted("triway-wide", kind, weight, weight, 0.12)
    for numbers, bound in ((of_objects, 0.12), (of_relations, 0.03)):
        values = (numbers(one, KINDS[kind]) for one in (artifact, drawn(artifact)))
        assert differences(*values).max() < bound


@pytest.mark.parametrize("largest", [70.0, 1.0])
def test_machines_without_closed_form(largest: float) -> None:
    """Machines with too large weights for products, in float64, or in the seed form."""
    machine = build(MachineSpec("triway", V=5, A=2, H1=70, K=2, form="local"))
    with torch.no_grad():
        machine.W[1, 2] = largest
    assert ClosedForm.supports(weights_of(machine)) == (largest < 64)
    assert not ClosedForm.supports(weights_of(machine.double()))
    seed = weights_of(build(MachineSpec("rbm", V=5, A=2, H1=70)))
    assert not ClosedForm.supports(seed)
    with pytest.raises(ValueError, match="local form"):
        ClosedForm(seed)
