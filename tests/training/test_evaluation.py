"""The metrics on cases worked out by hand, and their agreement with the machines."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from app.scene import ClassEvidence
from tests.training.test_objectives import toy_machine
from training.batches import SceneTensors, scene_tensors, seen_triples
from training.datasets import EncodedScene
from training.evaluation.intervals import bootstrap, ratio_figure
from training.evaluation.missing import leave_one_out, machine_score, missing_figures, with_unknown
from training.evaluation.outliers import intruder_scores
from training.evaluation.relations import expected_hits, rank_relations, rank_scored, score_scenes
from training.evaluation.relations import machine_score as relation_score

V = 5


def scene(classes, triples=(), source="toy", unknown=0) -> EncodedScene:
    n = len(classes)
    holds = np.zeros((2, n, n), dtype=np.bool_)
    for a, i, j in triples:
        holds[a, classes.index(i), classes.index(j)] = True
    evidence = ClassEvidence(
        classes=np.array(classes, dtype=np.int64),
        counts=np.ones(n, dtype=np.int64),
        confidence=np.ones(n),
        holds=holds,
        observed=np.ones_like(holds),
        room_type=None,
    )
    return EncodedScene(
        scene_id=str(id(evidence)),
        source=source,
        group="g",
        room_type=-1,
        evidence=evidence,
        instance_classes=evidence.classes,
        instance_holds=holds,
        instance_observed=evidence.observed,
        unknown=unknown,
    )


def tensors(scenes) -> SceneTensors:
    sources = {scene.source for scene in scenes}
    return scene_tensors(scenes, {s: np.ones(V, dtype=np.bool_) for s in sources}, V)


NO_STRUCTURE = torch.zeros(V, dtype=torch.bool)


def test_reciprocal_ranks_by_hand():
    """Scores fixed as 5, 4, 3, 2, 1: removing 2 from {0, 2} leaves 1 above it, and so on."""
    fixed = torch.tensor([5.0, 4, 3, 2, 1])
    result = leave_one_out(tensors([scene([0, 2])]), NO_STRUCTURE, lambda v: fixed.expand_as(v))
    assert dict(zip(result.target.tolist(), result.above.tolist(), strict=True)) == {0: 0, 2: 1}
    figures = missing_figures(result)
    assert figures["mrr"].value == pytest.approx((1 + 1 / 2) / 2)
    assert figures["top1"].value == pytest.approx(0.5)
    assert figures["mrr"].n == 2


def test_ties_score_their_expectation_under_random_order():
    """All equal, 4 candidates: the rank is uniform on 1..4."""
    flat = lambda v: torch.zeros_like(v)  # noqa: E731
    result = leave_one_out(tensors([scene([0, 2])]), NO_STRUCTURE, flat)
    expected = (1 + 1 / 2 + 1 / 3 + 1 / 4) / 4
    assert result.reciprocal_rank() == pytest.approx([expected] * 2)
    assert result.top(1) == pytest.approx([1 / 4] * 2)
    assert result.top(5) == pytest.approx([1.0] * 2)


def test_structure_is_neither_removed_nor_a_candidate():
    structure = NO_STRUCTURE.clone()
    structure[1] = True
    flat = lambda v: torch.tensor([0.0, 9, 0, 0, 0]).expand_as(v)  # noqa: E731
    result = leave_one_out(tensors([scene([0, 1, 2])]), structure, flat)
    assert sorted(result.target.tolist()) == [0, 2]
    assert result.above.tolist() == [0, 0]


def test_small_scenes_are_skipped_and_counted():
    result = leave_one_out(tensors([scene([0]), scene([0, 1])]), NO_STRUCTURE, lambda v: v)
    assert result.skipped == 1
    assert result.scenes == 2


def test_the_removed_object_cannot_leak():
    """What is scored never sees the target: the score of a scene with it equals that without."""
    seen = []

    def spy(v):
        seen.append(v.clone())
        return torch.zeros_like(v)

    leave_one_out(tensors([scene([0, 1, 2], [(0, 0, 1)])]), NO_STRUCTURE, spy)
    assert torch.cat(seen).tolist() == [[0, 1, 1, 0, 0], [1, 0, 1, 0, 0], [1, 1, 0, 0, 0]]


def test_unknown_labels_score_zero():
    result = leave_one_out(
        tensors([scene([0, 2], unknown=2)]), NO_STRUCTURE, lambda v: torch.zeros_like(v)
    )
    known = missing_figures(result)["mrr"].value
    assert with_unknown(result, np.array([2])).value == pytest.approx(known / 2)


def test_r_precision_by_hand():
    """Two annotated triples; the two best scores hit one of them."""
    data = tensors([scene([0, 1], [(0, 0, 1), (1, 1, 0)])])

    def score(batch):
        values = torch.zeros(1, 2, 2, 2)
        values[0, 0, 0, 1] = 3
        values[0, 0, 1, 0] = 2
        values[0, 1, 1, 0] = 1
        values[0, :, [0, 1], [0, 1]] = 9  # equal classes: no candidates
        return values

    ranking = rank_relations(data, NO_STRUCTURE, score)
    assert ranking.pooled().value == pytest.approx(0.5)
    left = rank_scored(score_scenes(data, score), NO_STRUCTURE, len(data), relation=0)
    assert left.pooled().value == 1.0


def test_expected_hits_shares_ties():
    values = torch.tensor([2.0, 1, 1, 1])
    truth = torch.tensor([False, True, False, False])
    assert expected_hits(values, truth, 2) == pytest.approx(1 / 3)


@pytest.mark.parametrize("name", ["rbm", "gbm", "triway-seed", "triway-local"])
def test_every_machine_can_be_evaluated(name):
    machine = toy_machine(name)
    data = tensors([scene([0, 1, 2], [(0, 1, 2)]), scene([0, 3, 4], [(1, 3, 4)])])
    result = leave_one_out(data, NO_STRUCTURE, machine_score(machine))
    assert np.isfinite(result.log_probability).all()
    ranking = rank_relations(data, NO_STRUCTURE, relation_score(machine))
    assert ranking.annotated.tolist() == [1, 1]
    scores = intruder_scores(data, NO_STRUCTURE, machine_score(machine))
    assert scores.intruder.sum() == 2
    assert 0 <= scores.auroc().value <= 1


def test_intruders_are_found_where_scores_know_them():
    """A score that knows the clean scene ranks the intruder last."""
    data = tensors([scene([0, 1, 2]), scene([0, 1, 2])])
    known = lambda v: torch.tensor([5.0, 5, 5, -5, -5]).expand_as(v)  # noqa: E731
    scores = intruder_scores(data, NO_STRUCTURE, known)
    assert scores.hit_at_1().value == 1.0
    assert scores.auroc().value == 1.0


def test_bootstrap_covers_the_truth():
    """Means of 200 samples of N(0, 1) x 100 scenes: 0 is within the 95 % interval 170 to 199 times.

    A binomial of 200 and .95 leaves that range with probability below 1e-5.
    """
    rng = np.random.default_rng(0)
    covered = 0
    for k in range(200):
        x = rng.normal(size=100)
        figure = bootstrap(lambda index, x=x: float(x[index].mean()), 100, 100, 300, seed=k)
        covered += figure.low <= 0 <= figure.high
    assert 170 <= covered <= 199


def test_nothing_scored_is_an_error():
    with pytest.raises(ValueError, match="no scene"):
        ratio_figure(np.zeros(2), np.zeros(2))


def test_seen_triples_are_counted_by_scene():
    scenes = [scene([0, 1], [(0, 0, 1)]), scene([0, 1], [(0, 0, 1), (1, 1, 0)])]
    assert seen_triples(scenes, V).tolist() == [[0, 0, 1], [1, 1, 0]]
    assert seen_triples(scenes, V, minimum=2).tolist() == [[0, 0, 1]]
