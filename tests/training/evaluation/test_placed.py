"""T2-at: what is asked, by hand, and agreement with the service."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from app.questions import missing
from app.registry import CountSlope, PairSlope
from app.scene import CANONICAL, OPPOSITES, Scene, SceneObject
from tests.questions.artifacts import artifact_of
from tests.training.evaluation.scenes import (
    NO_STRUCTURE,
    WIDE,
    WIDE_STRUCTURE,
    larger_machine,
    random_scenes,
    scene,
    tensors,
)
from training.evaluation.placed import Places, leave_one_out_at, removed_places
from training.evaluation.scores import placed_score
from training.machines.arrays import machine_of

DATA = tensors(random_scenes(20), WIDE)


def test_every_class_in_a_relation_is_asked_for_once_by_one_of_its_relations():
    data = tensors([scene([0, 1, 1, 2, 3], [(0, 0, 1), (2, 2, 1)]), scene([0], [])])
    row, target, places = removed_places(data, NO_STRUCTURE)
    assert row.tolist() == [0, 0, 0]
    assert target.tolist() == [0, 1, 2]
    asked = list(
        zip(
            places.relation.tolist(),
            places.anchor.tolist(),
            places.outgoing.tolist(),
            strict=True,
        )
    )
    assert asked[0] == (0, 1, True)
    assert asked[1] in [(0, 0, False), (2, 2, False)]
    assert asked[2] == (2, 1, True)
    assert places.counts[0].tolist() == [0, 2, 1, 1, 0]
    assert places.counts[1].tolist() == [1, 0, 1, 1, 0]


def test_the_removed_class_cannot_leak():
    """It is neither present nor counted nor the anchor, and its relation was true."""
    row, target, places = removed_places(DATA, WIDE_STRUCTURE)
    for k, t, v, count, a, anchor, out in zip(
        row.tolist(),
        target.tolist(),
        places.v,
        places.counts,
        places.relation.tolist(),
        places.anchor.tolist(),
        places.outgoing.tolist(),
        strict=True,
    ):
        assert v[t] == count[t] == 0
        assert anchor != t
        assert v[anchor] == 1
        evidence = DATA.scenes[k].evidence
        x, y = np.searchsorted(evidence.classes, [t, anchor])
        assert evidence.holds[a, x, y] if out else evidence.holds[a, y, x]
        assert v.sum() == DATA.v[k].sum() - 1


def test_reciprocal_ranks_by_hand():
    """left(0, 1) and front(2, 1) in {0, 1, 2}; the score prefers higher classes."""
    data = tensors([scene([0, 1, 2], [(0, 0, 1), (1, 2, 1)])])
    fixed = torch.arange(5.0)
    found = leave_one_out_at(data, NO_STRUCTURE, lambda places: fixed.expand_as(places.v))
    # Absent but the target: 3 and 4, both above it.
    assert found.mrr().value == pytest.approx(1 / 3)
    assert found.mrr().n == 3
    assert sorted(found.relation.tolist()) in ([0, 0, 1], [0, 1, 1])
    none = leave_one_out_at(data, NO_STRUCTURE, lambda places: torch.zeros_like(places.v))
    assert none.mrr(0).value == pytest.approx((1 + 1 / 2 + 1 / 3) / 3)


def test_a_score_that_knows_the_place_is_perfect():
    """In every scene, what stands left of 1 is 0, and so on: relation and anchor tell the class."""
    data = tensors([scene([0, 1, 2], [(0, 0, 1)]), scene([1, 3], [(1, 3, 1)])])
    answer = {(0, 1, True): 0, (0, 0, False): 1, (1, 1, True): 3, (1, 3, False): 1}

    def score(places):
        values = torch.zeros_like(places.v)
        rows = zip(
            places.relation.tolist(), places.anchor.tolist(), places.outgoing.tolist(), strict=True
        )
        for row, key in enumerate(rows):
            values[row, answer[key]] = 1.0
        return values

    assert leave_one_out_at(data, NO_STRUCTURE, score).mrr().value == 1.0


def test_structure_and_equal_classes_are_not_asked():
    structure = NO_STRUCTURE.clone()
    structure[4] = True
    found = scene([0, 0, 1, 4], [(0, 0, 4), (3, 0, 1)])
    found.evidence.holds[2, 0, 0] = True
    _, target, places = removed_places(tensors([found]), structure)
    assert sorted(target.tolist()) == [0, 1]
    assert places.relation.tolist() == [3, 3]
    assert len(removed_places(tensors([scene([0, 4], [(0, 0, 4)])]), structure)[0]) == 0


def asked_of(machine, outgoing):
    """A place twice: {0, 2, 2, 5}, on-top of 2; and another row, which must not disturb it."""
    v, counts = torch.zeros(1, machine.spec.V), torch.zeros(1, machine.spec.V)
    v[0, [0, 2, 5]] = 1.0
    counts[0, [0, 2, 5]] = torch.tensor([1.0, 2.0, 1.0])
    rows = [(2, 2, outgoing), (0, 5, not outgoing)]
    relation, anchor, leads = (torch.tensor(column) for column in zip(*rows, strict=True))
    return Places(v.repeat(2, 1), counts.repeat(2, 1), relation, anchor, leads)


def answers_of(artifact, outgoing):
    things = tuple(SceneObject(str(k), "x", c) for k, c in enumerate([0, 2, 2, 5]))
    spoken = CANONICAL[2] if outgoing else OPPOSITES[CANONICAL[2]]
    return missing(artifact, Scene(things), top_k=artifact.spec.V, at=(spoken, 1))


MISSING = CountSlope(intercept=-0.3, slope=0.8, log_count=0.4)


@pytest.mark.parametrize("outgoing", [True, False])
@pytest.mark.parametrize("name", ["rbm", "triway-local"])
def test_the_question_names_the_place_as_a_robot_does(name, outgoing):
    """By the relation as the missing object's, with the instances that were counted."""
    slopes = (PairSlope(intercept=0.2, slope=0.7, log_count=0.3, log_classes=-0.4),) * 4
    artifact = artifact_of(larger_machine(name), missing=MISSING, placement=slopes, coverage=0.7)
    answers = answers_of(artifact, outgoing)
    values = placed_score(artifact)(asked_of(machine_of(artifact.weights), outgoing))[0]
    for answer in answers:
        found = values[artifact.vocabulary.index(answer.label)]
        assert float(found.exp()) == pytest.approx(answer.probability, rel=1e-5)
    # Structure and what is there are no candidates.
    assert int((values > -torch.inf).sum()) == len(answers)
