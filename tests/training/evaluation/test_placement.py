"""T3b: which triple is altered, into what, and who finds it."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from tests.training.evaluation.scenes import (
    NO_STRUCTURE,
    WIDE,
    WIDE_STRUCTURE,
    flat,
    knowing,
    random_scenes,
    scene,
    tensors,
)
from training.evaluation.placement import alter, placement_scores

DATA = tensors(random_scenes(30), WIDE)


def test_perfect_and_ignorant_scores():
    scores = placement_scores(DATA, WIDE_STRUCTURE, knowing(DATA))
    assert scores.hit_at_1().value == scores.auroc().value == 1.0
    scores = placement_scores(DATA, WIDE_STRUCTURE, flat)
    triples = np.bincount(scores.scene)
    expected = (1 / triples[triples > 0]).mean()
    assert scores.hit_at_1().value == pytest.approx(expected)
    assert scores.auroc().value == pytest.approx(0.5)


def test_one_triple_is_replaced_by_a_false_one():
    """All others stay; what replaces it shares two of relation, subject, object with it."""
    batches = []

    def spy(batch):
        batches.append(batch)
        return torch.zeros(batch.holds.shape)

    placement_scores(DATA, WIDE_STRUCTURE, spy, block=1)
    related = [entry.evidence for entry in DATA.scenes if entry.evidence.holds.sum() >= 2]
    kinds = set()
    for batch, evidence in zip(batches, related, strict=True):
        stated = batch.holds[0].numpy() > 0
        assert bool((batch.observed[0].numpy() == stated).all())
        (gone,), (new,) = (
            np.argwhere(evidence.holds & ~stated),
            np.argwhere(stated & ~evidence.holds),
        )
        same = gone == new
        assert same.sum() == 2
        kinds.add(int(np.flatnonzero(~same)[0]))
        a, i, j = new
        assert not evidence.holds[a, j, i]
        assert i != j
    assert kinds == {0, 1, 2}


def test_without_a_false_triple_there_is_no_case():
    rng = np.random.default_rng(0)
    holds, off = np.ones((1, 2, 2), np.bool_), ~np.eye(2, dtype=np.bool_)
    assert alter(holds & off, np.broadcast_to(off, holds.shape), rng) is None
    one = np.zeros((1, 2, 2), np.bool_)
    one[0, 0, 1] = True
    assert alter(one, np.broadcast_to(off, one.shape), rng) is None


def test_structure_takes_no_part():
    structure = NO_STRUCTURE.clone()
    structure[2] = True
    data = tensors([scene([0, 1, 2], [(0, 0, 1), (1, 0, 1), (0, 0, 2)]) for _ in range(20)])
    scores = placement_scores(data, structure, flat)
    assert np.bincount(scores.scene).tolist() == [2] * 20


def test_scenes_with_one_triple_are_skipped_and_counted():
    data = tensors([scene([0, 1], [(0, 0, 1)]), scene([0, 1], [(0, 0, 1), (1, 0, 1)])])
    scores = placement_scores(data, NO_STRUCTURE, flat)
    assert (scores.scenes, scores.skipped, scores.scene.tolist()) == (2, 1, [1, 1])
    assert len(placement_scores(tensors([scene([0, 1])]), NO_STRUCTURE, flat).scene) == 0
