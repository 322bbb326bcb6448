from dataclasses import replace

import numpy as np
import pytest
import torch
from sklearn.neighbors import NearestNeighbors
from sklearn.neural_network import BernoulliRBM

from tests.training.research.baselines.furnished import (
    LEFT,
    ON_TOP,
    STRUCTURE,
    A,
    V,
    scene,
    tensors,
)
from training.evaluation import baselines
from training.evaluation.baselines import Lists, fit_ease, frequency, training_lists
from training.evaluation.generation_task import transitive_closure
from training.evaluation.relation_tasks import with_observed
from training.evaluation.setting import Places
from training.research.baselines.count_models import closure_score, complex_logits
from training.research.baselines.object_models import (
    bernoulli_rbm,
    evidence,
    fit_pairwise,
    hidden_loss,
    nearest_score,
)


def lists_of(v):
    everything = torch.ones(v.shape, dtype=torch.bool)
    return Lists(v, everything, torch.ones(len(v)), torch.arange(len(v)))


@pytest.fixture(scope="module")
def v() -> torch.Tensor:
    """(200, 6) presence: pairs of classes that go together, and one on its own."""
    rng = np.random.default_rng(0)
    base = rng.random((200, 3)) < 0.4
    pairs = [base[:, k // 2] ^ (rng.random(200) < 0.15) for k in range(5)]
    return torch.from_numpy(np.stack([*pairs, rng.random(200) < 0.3], 1)).float()


def test_ease_is_a_ridge_regression_of_each_class_on_the_others(v):
    score = fit_ease(v, 7.0)
    x = v.double().numpy()
    mean = x.mean(0)
    for i in range(x.shape[1]):
        others = [j for j in range(x.shape[1]) if j != i]
        design = x[:, others] - mean[others]
        gram = design.T @ design + 7.0 * np.eye(len(others))
        weights = np.linalg.solve(gram, design.T @ (x[:, i] - mean[i]))
        assert score.weights[others, i].numpy() == pytest.approx(weights, abs=1e-5)
        assert float(score.bias[i]) == pytest.approx(mean[i] - mean[others] @ weights, abs=1e-5)


def test_naive_bayes_by_counting(v):
    weights = evidence(v, smoothing=2.0)
    x = v.numpy() > 0
    average = (x.sum(0) + 0.5) / (len(x) + 1)
    for i, j in ((0, 1), (1, 0), (4, 2), (5, 3)):
        given, without = x[x[:, i], j], x[~x[:, i], j]
        p = (given.sum() + 2 * average[j]) / (len(given) + 2)
        q = (without.sum() + 2 * average[j]) / (len(without) + 2)
        assert float(weights[j, i]) == pytest.approx(np.log(p / q), abs=1e-5)
    assert not weights.diagonal().any()


@pytest.mark.parametrize("sharpness", [1.0, 3.0])
def test_nearest_scenes_are_scikit_learns(v, sharpness):
    train, query = v[:150], v[150:170]
    query = query[query.any(1)]
    score = nearest_score(lists_of(train), neighbours=150, sharpness=sharpness)
    rows = train.any(1)  # scikit-learn knows no cosine of an empty scene; such scenes have no vote
    search = NearestNeighbors(n_neighbors=int(rows.sum()), metric="cosine").fit(train[rows])
    distance, place = search.kneighbors(query)
    vote = ((1 - distance) / (1 - distance[:, :1])) ** sharpness
    share = (vote[:, :, None] * train[rows].numpy()[place]).sum(1) + frequency(train).numpy()
    expected = share / (vote.sum(1, keepdims=True) + 1)
    assert score(query).sigmoid().numpy() == pytest.approx(expected, abs=1e-5)


def test_pairwise_weights_are_a_stationary_point(v):
    l2 = 5.0
    score = fit_pairwise(lists_of(v), l2, iterations=200)
    W, x = score.weights.double(), v.double()
    assert torch.equal(score.weights, score.weights.T)
    residual = torch.sigmoid(score.bias.double() + x @ W) - x
    assert residual.sum(0).abs().max() < 1e-2
    slope = residual.T @ x + x.T @ residual + l2 * W
    slope.fill_diagonal_(0.0)
    assert slope.abs().max() < 2e-2
    assert W[0, 1] > 1.0, "classes that go together attract"


def test_the_rbms_log_odds_are_scikit_learns_free_energies(v):
    """F(v without i) - F(v with i), by scikit-learn's own function."""
    scenes = tensors([scene([k for k in range(6) if row[k]]) for row in v[:60]])
    _, score = next(bernoulli_rbm(scenes, STRUCTURE, 0))
    rbm = BernoulliRBM(n_components=len(score.c))
    rbm.components_ = score.W.numpy()
    rbm.intercept_hidden_ = score.c.numpy()
    rbm.intercept_visible_ = score.b.numpy()
    for i in range(V):
        on, off = scenes.v[:5].clone(), scenes.v[:5].clone()
        on[:, i], off[:, i] = 1.0, 0.0
        expected = rbm._free_energy(off.numpy()) - rbm._free_energy(on.numpy())
        assert score(off)[:, i].numpy() == pytest.approx(expected, abs=1e-3)


@pytest.mark.parametrize(("loss", "expected"), [("softmax", np.log(3)), ("binary", 3 * np.log(2))])
def test_the_loss_of_a_flat_network(loss, expected):
    """{0, 1} of 5 classes, one of which the source cannot show: three candidates remain."""
    v = torch.tensor([[1.0, 1, 0, 0, 0]]).expand(8, -1)
    labelled = torch.tensor([True, True, False, True, True]).expand(8, -1)
    value = hidden_loss(lambda x: torch.zeros_like(x), v, labelled, loss)
    assert float(value) == pytest.approx(expected, abs=1e-5)


def test_scenes_have_their_weights_and_partial_labels():
    """Class 1 is unlabelled in the second source; the third scene is incomplete and weighs 3."""
    some = [scene([0, 1, 9]), scene([0], source="b"), scene([2], source="b")]
    some[2] = replace(some[2], complete=False, weight=3.0)
    able = torch.ones(2, V, dtype=torch.bool)
    able[0, 1] = False
    train = replace(tensors(some), annotated_classes=able)
    assert train.source_names == ("b", "toy")
    every, complete, absent, complete_absent = dict(training_lists(train, STRUCTURE)).values()
    assert every.weight.tolist() == pytest.approx([0.6, 0.6, 1.8])
    assert not every.v[:, 9].any()
    assert not every.labelled[:, 9].any()
    assert every.frequency()[1] == pytest.approx((0.6 + 0.5) / (0.6 + 1))
    assert every.frequency()[2] == pytest.approx((1.8 + 0.5) / (3 + 1))
    assert every.filled()[:, 1].tolist() == pytest.approx([1, 1.1 / 1.6, 1.1 / 1.6])
    assert complete.index.tolist() == complete_absent.index.tolist() == [0, 1]
    assert complete.weight.tolist() == [1, 1]
    assert torch.equal(absent.labelled, (~STRUCTURE).expand_as(absent.v))


def test_a_scene_of_weight_two_counts_twice(v):
    twice = torch.cat([v[:50], v])
    weight = 1.0 + (torch.arange(len(v)) < 50)
    for ours, theirs in (
        (fit_ease(v, 7.0, weight), fit_ease(twice, 7.0)),
        (
            fit_pairwise(replace(lists_of(v), weight=weight), 5.0, iterations=200),
            fit_pairwise(lists_of(twice), 5.0, iterations=200),
        ),
    ):
        assert torch.allclose(ours.weights, theirs.weights, atol=2e-3)
    assert torch.allclose(evidence(v, 2.0, weight), evidence(twice, 2.0), atol=1e-4)


@pytest.fixture(scope="module")
def related():
    """0 on 1 in two of three scenes, 0 left of 2 once; a scene that nobody annotated."""
    return tensors(
        [
            scene([0, 1, 2], [(ON_TOP, 0, 1), (LEFT, 0, 2)]),
            scene([0, 1, 1, 1], [(ON_TOP, 0, 1)]),
            scene([0, 1, 9], [(ON_TOP, 0, 9)]),
            scene([0, 1], annotated=False),
        ]
    )


def test_triples_by_hand(related):
    counts = baselines.count_triples(related, STRUCTURE)
    assert counts.holds.nonzero().tolist() == [[LEFT, 0, 2], [ON_TOP, 0, 1]]
    assert counts.holds[ON_TOP, 0, 1] == 2
    assert counts.together[0, 1] == counts.together[1, 0] == 3
    assert counts.together[0, 2] == 1
    assert counts.together[0, 9] == 0, "structure is no end"
    assert counts.together.diagonal().sum() == 0


def test_the_frequency_table_by_hand(related):
    counts = baselines.count_triples(related, STRUCTURE)
    p = baselines.smoothed_log_odds(counts, of_pair=4.0, of_class=2.0).sigmoid()
    # Ordered pairs together: 3 + 3 of (0, 1), 1 + 1 each of (0, 2) and (1, 2).
    overall = (2 + 1) / (10 + 2)
    subject = (2 + 2 * overall) / (4 + 2)
    object_ = (2 + 2 * overall) / (4 + 2)
    expected = (2 + 4 * (subject + object_) / 2) / (3 + 4)
    assert float(p[ON_TOP, 0, 1]) == pytest.approx(expected, abs=1e-5)
    never = (0 + 4 * (2 * overall / (0 + 2) * 2) / 2) / (0 + 4)
    assert float(p[ON_TOP, 5, 6]) == pytest.approx(never, abs=1e-5)


def test_tables_are_looked_up_for_the_classes_of_a_scene(related):
    table = torch.randn(A, V, V, generator=torch.Generator().manual_seed(0))
    batch = related.batch(torch.tensor([1, 0]))
    values = baselines.table_score(table)(batch)
    assert values[1, LEFT, 2, 0] == table[LEFT, 2, 0]
    assert values[0, ON_TOP, 0, 1] == table[ON_TOP, 0, 1]
    more = baselines.table_score(table, multiplicity=0.5)(batch) - values
    assert float(more[0, LEFT, 0, 1]) == pytest.approx(0.5 * np.log(3), abs=1e-6)
    assert float(more[0, LEFT, 1, 1]) == pytest.approx(np.log(3), abs=1e-6)
    assert not more[1].any()


def test_closure_is_warshalls():
    given = torch.rand(20, 7, 7, generator=torch.Generator().manual_seed(0)) < 0.15
    expected = given.clone()
    for k in range(7):
        expected |= expected[:, :, k : k + 1] & expected[:, k : k + 1, :]
    assert torch.equal(transitive_closure(given), expected)


def test_closure_changes_implied_relations_and_mirror_images_alone():
    batch = tensors([scene([0, 1, 2, 3], [(LEFT, 0, 1), (LEFT, 1, 2)])]).batch(torch.tensor([0]))
    given = with_observed(batch, batch.holds > 0)
    moved = closure_score(baselines.table_score(torch.zeros(A, V, V)), bonus=2.0, penalty=3.0)(
        given
    )
    expected = torch.zeros(1, A, 4, 4)
    expected[0, LEFT, 0, 2] = 2.0
    for i, j in ((1, 0), (2, 1), (2, 0)):
        expected[0, LEFT, i, j] = -3.0
    assert torch.equal(moved, expected)


def test_complex_logits_by_einsum():
    generator = torch.Generator().manual_seed(0)
    bias = torch.randn(2, generator=generator)
    r = torch.randn(2, 3, dtype=torch.cfloat, generator=generator)
    s = torch.randn(5, 3, dtype=torch.cfloat, generator=generator)
    expected = torch.einsum("ik,ak,jk->aij", s, r, s.conj()).real + bias[:, None, None]
    torch.testing.assert_close(complex_logits(bias, r, s), expected)


def test_places_by_hand(related):
    counts = baselines.count_triples(related, STRUCTURE)
    log_p = baselines.smoothed_log_p(counts, torch.full((V,), 0.5), place=2.0, relation=1.0)
    assert log_p.exp().sum(-1) == pytest.approx(torch.ones(2, A, V), abs=1e-5)
    # Something on 1: 0 twice. Whatever is on something: 0 twice, and one case of 1/11 each.
    back_off = (2 + 1 / 11) / (2 + 1)
    # Second, something under 0: 1 twice.
    v, relation = torch.zeros(2, V), torch.tensor([ON_TOP, ON_TOP])
    places = Places(v, v, relation, torch.tensor([1, 0]), torch.tensor([True, False]))
    first, second = baselines.place_score(log_p)(places)
    assert float(first[0].exp()) == pytest.approx((2 + 2 * back_off) / (2 + 2), abs=1e-5)
    assert second.argmax() == 1
