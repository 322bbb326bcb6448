"""T1a by hand."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from tests.training.evaluation.scenes import (
    NO_STRUCTURE,
    WIDE,
    WIDE_STRUCTURE,
    V,
    flat,
    knowing,
    random_scenes,
    scene,
    tensors,
    toy,
)
from tests.training.test_objectives import toy_machine
from training.batches import seen_triples
from training.evaluation.relations import (
    candidates,
    expected_hits,
    machine_score,
    of_relation,
    rank,
    rank_relations,
    score_scenes,
    unseen,
)


def by_hand(batch):
    """left(0,1) before left(1,0) before front(1,0); equal classes are no candidates."""
    values = torch.zeros(1, 2, 2, 2)
    values[0, 0, 0, 1] = 3
    values[0, 0, 1, 0] = 2
    values[0, 1, 1, 0] = 1
    values[0, :, [0, 1], [0, 1]] = 9
    return values


def test_r_precision_by_hand():
    """Two annotated triples; the two best scores hit one of them."""
    data = tensors([toy([0, 1], [(0, 0, 1), (1, 1, 0)])])
    assert rank_relations(data, NO_STRUCTURE, by_hand).pooled().value == pytest.approx(0.5)
    scored = candidates(score_scenes(data, by_hand), NO_STRUCTURE)
    assert rank(of_relation(scored, 0), 1).pooled().value == 1.0
    assert rank(scored, 1, first=3).pooled().value == 1.0
    assert rank(scored, 1, first=1).pooled().value == 0.5
    assert rank(scored, 1, first=20).pooled().value == 1.0


def test_scenes_count_alike_or_by_their_triples():
    data = tensors([toy([0, 1], [(0, 0, 1), (1, 1, 0)]), toy([0, 1], [(0, 0, 1)]), toy([0, 1])])
    ranking = rank_relations(
        data, NO_STRUCTURE, lambda batch: by_hand(batch).expand(len(batch), -1, -1, -1)
    )
    assert ranking.annotated.tolist() == [2, 1, 0]
    assert ranking.skipped == 1
    assert ranking.pooled().value == pytest.approx(2 / 3)
    assert ranking.per_scene().value == pytest.approx((1 / 2 + 1) / 2)


def test_zero_shot_ranks_unseen_triples_alone():
    """left(0,1) was seen; of the others left(1,0) comes first and front(1,0) is the true one."""
    data = tensors([toy([0, 1], [(0, 0, 1), (1, 1, 0)])])
    scored = candidates(score_scenes(data, by_hand), NO_STRUCTURE)
    seen = torch.tensor([[0, 0, 1]])
    ranking = rank(unseen(scored, seen, V), 1)
    assert ranking.annotated.tolist() == [1]
    assert ranking.pooled().value == 0.0
    both = torch.tensor([[0, 0, 1], [0, 1, 0]])
    assert rank(unseen(scored, both, V), 1).pooled().value == 1.0


def test_perfect_and_ignorant_scores():
    """A flat score hits R of R out of k candidates: R² / k in expectation."""
    data = tensors(random_scenes(12), WIDE)
    assert rank_relations(data, WIDE_STRUCTURE, knowing(data)).pooled().value == 1.0
    ranking = rank_relations(data, WIDE_STRUCTURE, flat)
    related = [entry.evidence for entry in data.scenes if entry.evidence.holds.any()]
    n = np.array([len(evidence.classes) for evidence in related])
    R = ranking.annotated[ranking.annotated > 0]
    assert ranking.hits[ranking.annotated > 0] == pytest.approx(R**2 / (4 * n * (n - 1)))


def test_structure_is_no_end_of_a_relation():
    structure = NO_STRUCTURE.clone()
    structure[1] = True
    data = tensors([scene([0, 1, 2], [(0, 0, 1), (0, 0, 2)])])
    (scored,) = candidates(score_scenes(data, flat), structure)
    assert len(scored.score) == 4 * 2
    assert scored.truth.sum() == 1


def test_what_is_scored_sees_no_relation():
    """T1a asks with all relations hidden, and with nobody having counted if so wished."""
    seen = []

    def spy(batch):
        seen.append(batch)
        return torch.zeros(batch.holds.shape)

    data = tensors([scene([0, 1, 1], [(0, 0, 1)])])
    score_scenes(data, spy)
    score_scenes(data, spy, counts=False)
    assert not any(bool(batch.holds.any()) or bool(batch.observed.any()) for batch in seen)
    assert [batch.counts.tolist() for batch in seen] == [[[1, 2]], [[0, 0]]]


def test_expected_hits_shares_ties():
    values, truth = np.array([2.0, 1, 1, 1]), np.array([False, True, False, False])
    assert expected_hits(values, truth, 2) == pytest.approx(1 / 3)
    assert expected_hits(values, truth, 9) == 1.0
    assert expected_hits(np.full(4, -np.inf), truth, 1) == pytest.approx(1 / 4)


def test_a_score_that_is_no_number_is_an_error():
    data = tensors([scene([0, 1], [(0, 0, 1)])])
    with pytest.raises(FloatingPointError, match="not a number"):
        rank_relations(data, NO_STRUCTURE, lambda batch: flat(batch) * float("nan"))


@pytest.mark.parametrize("name", ["rbm", "gbm", "triway-seed", "triway-local"])
def test_every_machine_can_be_evaluated(name):
    data = tensors([toy([0, 1, 2], [(0, 1, 2)]), toy([0, 3, 4], [(1, 3, 4)])])
    ranking = rank_relations(data, NO_STRUCTURE, machine_score(toy_machine(name)))
    assert ranking.annotated.tolist() == [1, 1]


def test_seen_triples_are_counted_by_scene():
    scenes = [scene([0, 1], [(0, 0, 1)]), scene([0, 1], [(0, 0, 1), (1, 1, 0)])]
    assert seen_triples(scenes, V).tolist() == [[0, 0, 1], [1, 1, 0]]
    assert seen_triples(scenes, V, minimum=2).tolist() == [[0, 0, 1]]
