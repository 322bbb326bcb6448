"""T2-at: what is asked, by hand, and agreement with the service."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from app.reasoning import missing
from app.scene import CANONICAL, OPPOSITES, Scene, SceneObject
from tests.reasoning.artifacts import LARGER, artifact_of
from tests.training.evaluation.scenes import (
    NO_STRUCTURE,
    WIDE,
    WIDE_STRUCTURE,
    random_scenes,
    scene,
    tensors,
)
from tests.training.evaluation.test_completion import larger_machine
from training.evaluation.placed import Places, leave_one_out_at, removed_places
from training.evaluation.scores import machine_scores

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


@pytest.mark.parametrize("outgoing", [True, False])
@pytest.mark.parametrize("name", LARGER)
def test_the_score_is_the_service_s(name, outgoing):
    """Softmax of the score over absent classes is the answer of the service, uncalibrated."""
    machine = larger_machine(name)
    artifact = artifact_of(machine)
    classes, relation, anchor = [0, 2, 2, 5], 2, 2
    things = tuple(SceneObject(str(k), "x", c) for k, c in enumerate(classes))
    spoken = CANONICAL[relation] if outgoing else OPPOSITES[CANONICAL[relation]]
    answers = missing(artifact, Scene(things), top_k=machine.spec.V, at=(spoken, 1))
    v, counts = torch.zeros(1, machine.spec.V), torch.zeros(1, machine.spec.V)
    v[0, classes] = 1.0
    counts[0, [0, 2, 5]] = torch.tensor([1.0, 2.0, 1.0])
    places = Places(
        v, counts, torch.tensor([relation]), torch.tensor([anchor]), torch.tensor([outgoing])
    )
    # Rows of a batch do not disturb each other.
    other = Places(v, counts, torch.tensor([0]), torch.tensor([5]), torch.tensor([not outgoing]))
    both = Places(
        *(torch.cat([getattr(x, n) for x in (places, other)]) for n in Places.__dataclass_fields__)
    )
    values = machine_scores(machine).placed(both)[0].double()
    labels = artifact.vocabulary.labels
    absent = [labels.index(answer.label) for answer in answers]
    expected = torch.tensor([answer.probability for answer in answers]).double()
    torch.testing.assert_close(values[absent].softmax(0), expected, rtol=1e-3, atol=1e-5)
