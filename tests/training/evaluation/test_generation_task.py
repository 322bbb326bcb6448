import numpy as np
import pytest
import torch

from tests.enumeration.small_machines import small_machine
from tests.questions.artifacts import artifact_of
from tests.training.evaluation.scenes import WIDE, random_scenes, scene, tensors
from training.evaluation import generation_task
from training.evaluation.setting import Drawn, Evidence, Setting

X = torch.tensor([[1.0, 0, 0], [1, 1, 0]])
Y = torch.tensor([[1.0, 0, 0], [0, 0, 1], [0, 1, 1]])


def test_distances_and_copies_by_hand():
    # 2, 3 and 1 between the rows of Y.
    assert generation_task.median_distance(Y) == 2.0
    assert generation_task.copies(X, Y).tolist() == [1.0, 0.0]


def test_discrepancy_and_marginal_error_by_hand():
    k = lambda d: np.exp(-np.asarray(d) / 2.0)  # noqa: E731
    expected = k(1) + k([2, 3, 1]).mean() - 2 * k([[0, 2, 3], [1, 3, 2]]).mean()
    at = generation_task.discrepancy(Y, X, 2.0)
    assert at(np.ones(3)) == pytest.approx(expected)
    # A scene drawn twice is no pair of its own.
    twice = k(1) + k(2) - 2 * (2 * k([0, 1]).mean() + k([2, 3]).mean()) / 3
    assert at(np.array([2.0, 1, 0])) == pytest.approx(twice)
    marginal = generation_task.marginal_error(Y.numpy().astype(float), X.numpy().astype(float))
    assert marginal(np.ones(3)) == pytest.approx((2 / 3 + 1 / 6 + 2 / 3) / (4 / 3))


def test_pair_correlation_by_hand():
    """Covariances of (0,1), (0,2), (1,2) against those of another sample."""
    rng = np.random.default_rng(0)
    x, y = ((rng.random((30, 3)) < 0.5).astype(float) for _ in range(2))
    pairs = [(0, 1), (0, 2), (1, 2)]
    cov = [[np.cov(v.T, bias=True)[p] for p in pairs] for v in (x, y)]
    expected = np.corrcoef(*cov)[0, 1]
    assert generation_task.pair_correlation(y, x)(np.ones(30)) == pytest.approx(expected)
    assert generation_task.pair_correlation(y, y)(np.ones(30)) == pytest.approx(1.0)


def test_contradictions_by_hand():
    """Mirrored pairs are counted by pair; cycles of on-top are found whatever their length.
    left(0,1), left(1,0), left(0,2), front(2,2): two related pairs, one of them both ways. Then a
    tower of three; the same with its foot on its top; nothing but left, in a circle."""
    holds = torch.zeros(4, 4, 3, 3)
    for a, i, j in [(0, 0, 1), (0, 1, 0), (0, 0, 2), (1, 2, 2)]:
        holds[3, a, i, j] = 1
    for k, i, j in [(0, 0, 1), (0, 1, 2), (1, 0, 1), (1, 1, 2), (1, 2, 0)]:
        holds[k, 2, i, j] = 1
    holds[2, 0] = torch.eye(3).roll(1, 1)
    holds[:, 2, 1, 1] = 1  # of itself: two books, one on the other
    counts = generation_task.count_contradictions(holds)
    mirrored, related, cyclic, stacked = counts.T.tolist()
    assert (related[3], mirrored[3]) == (2, 1)
    assert stacked == [True, True, False, False]
    assert cyclic == [False, True, False, False]
    metrics = generation_task.contradiction_metrics(counts)
    assert metrics["mirrored relations"].value == sum(mirrored) / sum(related)
    assert metrics["on-top cycles"].value == 1 / 2


def test_halves_keep_groups_together():
    scenes = tensors([scene([0, 1], group=f"g{k // 2}") for k in range(40)])
    first, second = generation_task.held_out_halves(
        Setting(scenes, torch.zeros(5, dtype=torch.bool))
    )
    assert len(first) + len(second) == 40
    assert min(len(first), len(second)) >= 5
    assert not {s.group for s in first.scenes} & {s.group for s in second.scenes}


def test_scenes_that_fit_are_their_own_sampler():
    scenes = tensors([scene([0, 1], room=0), scene([1, 2], room=1), scene([3], room=1)], WIDE)
    given = torch.zeros(3, WIDE, dtype=torch.bool)
    evidence = Evidence(given, scenes.room, 0, scenes, scenes)
    assert bool((generation_task.held_out_scenes(evidence).v == scenes.v).all())
    given[:, 2] = True
    assert bool((generation_task.held_out_scenes(evidence).v == scenes.v[1]).all())


def test_given_one_class_scenes_count_by_their_size():
    """Enumerated: draw a class among all mentions, then a scene that has it; large ones come up
    more often, and held-out scenes that count by size have the same marginals."""
    held_out = torch.tensor([[1.0, 1, 1, 0], [1, 0, 0, 0], [0, 0, 1, 1]])
    drawn = [
        held_out[k]
        for i in held_out.nonzero()[:, 1].tolist()
        for k in held_out[:, i].nonzero().squeeze(1).tolist()
        for _ in range(2 // int(held_out[:, i].sum()))
    ]
    asked = torch.ones(4, dtype=torch.bool)
    size = held_out.sum(1)
    generated = Drawn(torch.stack(drawn), torch.zeros(len(drawn), 4))
    for emphasis, expected in ((size, 0.0), (None, 1 / 6)):
        metrics = generation_task.generation_metrics(
            generated, held_out, np.arange(3), held_out, asked, 2.0, emphasis
        )
        assert metrics["marginal error"].value == pytest.approx(expected, abs=1e-9)


def test_independent_classes_have_the_frequencies_of_training():
    """2,000 draws: each frequency within 5 standard errors."""
    train = tensors(random_scenes(50), WIDE)
    given = torch.zeros(2000, WIDE, dtype=torch.bool)
    given[:, 3] = True
    evidence = Evidence(given, torch.full((2000,), -1), 0, train, train)
    v = generation_task.independent_scenes(evidence).v
    p = train.v.mean(0)
    error = (v.mean(0) - p).abs()
    error[3] = 0
    assert bool((error <= 5 * (p * (1 - p) / 2000).sqrt()).all())
    assert bool((v[:, 3] == 1).all())


def test_given_classes_stay():
    artifact = artifact_of(small_machine("triway").float())
    given = torch.tensor([[True, False]]).expand(50, -1)
    none = tensors([scene([0])])
    evidence = Evidence(given, torch.full((50,), -1), 1, none, none)
    drawn = generation_task.machine_scenes(artifact, evidence)
    assert bool((drawn.v[:, 0] == 1).all())
    assert 0 < float(drawn.v[:, 1].mean()) < 1
