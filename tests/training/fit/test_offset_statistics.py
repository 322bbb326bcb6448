from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import chi2, invgamma, norm

from app.scene.spatial_relations import LEFT, ON_TOP
from tests.training.evaluation.scenes import scene
from tests.training.fit.test_count_statistics import check_stored_exactly
from training.datasets import encode, generate_rooms, rooms_vocabulary
from training.datasets.cases import observed_offsets
from training.fit.offset_statistics import fit_offsets, log_likelihood, posterior

V = 6


def apart(offset, i=0, j=1, *, relation=LEFT, source="toy"):
    found = scene([i, j], [(relation, i, j)], source=source)
    return replace(found, instance_positions=np.array([offset, (0.0, 0.0, 0.0)]))


def draws(mean, std, number, seed, **pair):
    rng = np.random.default_rng(seed)
    return [apart(tuple(rng.normal(mean, std)), **pair) for _ in range(number)]


def of_pair(offsets, i=0, j=1, relation=LEFT):
    values, scenes = offsets.find(np.array([relation]), np.array([i]), np.array([j]))
    return values[0, :3], values[0, 3:], int(scenes[0])


def moments(values):
    values = np.array(values)
    return len(values), values.mean(), np.square(values - values.mean()).sum()


PRIOR = (0.3, 2.0, 2.5, 0.4)  # expected, kappa, alpha, beta
VALUES = (0.1, 0.5, 1.1)


def joint(m, s):
    expected, kappa, alpha, beta = PRIOR
    prior = invgamma.pdf(s, alpha, scale=beta) * norm.pdf(m, expected, np.sqrt(s / kappa))
    return prior * np.prod([norm.pdf(value, m, np.sqrt(s)) for value in VALUES], axis=0)


MEANS, VARIANCES = np.meshgrid(np.linspace(-6, 7, 326), np.geomspace(1e-3, 200, 500))


def integral(values):
    """Of values (on the grid) over every mean and variance that matters; steps grow with s."""
    return (values * joint(MEANS, VARIANCES) * VARIANCES).sum() * 0.04 * np.log(2e5) / 499


def test_the_posterior_and_the_likelihood_are_the_integrals():
    evidence = integral(np.ones_like(MEANS))
    mean = integral(MEANS) / evidence
    second = integral(VARIANCES + np.square(MEANS)) / evidence
    found, variance = posterior(PRIOR, *moments(VALUES))
    assert log_likelihood(PRIOR, *moments(VALUES)) == pytest.approx(np.log(evidence), abs=1e-4)
    assert found == pytest.approx(mean, abs=1e-4)
    assert variance == pytest.approx(second - mean**2, rel=2e-3)


MEAN, STD = np.array([0.1, 1.2, -0.3]), np.array([0.4, 0.2, 0.05])


def many_pairs(number=30, seed=2):
    rng = np.random.default_rng(seed)
    found = []
    for i in range(number):
        for j in range(i + 1, number):
            mean = MEAN + rng.normal(0, 0.3, 3)
            times = 1 if (i + j) % 5 == 0 else 6
            found += [apart(tuple(rng.normal(mean, STD)), i, j) for _ in range(times)]
    return found, number


def test_pairs_that_are_seldom_or_never_seen_are_covered_too():
    """Fresh draws of pairs seen once, and of unseen ones: 70 to 90 % of 1,000 each inside, as the
    spread of the pairs' means has to be learnt as well. The seeds are fixed."""
    scenes, number = many_pairs()
    offsets = fit_offsets(scenes, number)
    rng = np.random.default_rng(3)
    seldom = [s for s in scenes if s.instance_classes.sum() % 5 == 0]
    inside = {"seldom": [], "never": []}
    for entry in seldom:
        i, j = entry.instance_classes
        mean, spread, scenes_of = of_pair(offsets, i, j)
        assert scenes_of == 1
        # The pair's mean given its one draw, and a new draw around it.
        shrunk = np.square(0.3) / (np.square(0.3) + np.square(STD))
        given_one = MEAN + shrunk * (entry.instance_positions[0] - MEAN)
        truth = rng.normal(given_one, 0.3 * np.sqrt(1 - shrunk), (12, 3))
        new = rng.normal(truth, STD)
        inside["seldom"] += list(np.square((new - mean) / spread).sum(axis=1))
    mean, spread, scenes_of = of_pair(offsets, 5, 3)
    assert scenes_of == 0
    new = rng.normal(MEAN + rng.normal(0, 0.3, (1000, 3)), STD)
    inside["never"] = list(np.square((new - mean) / spread).sum(axis=1))
    for kind, distances in inside.items():
        assert 0.7 <= (np.array(distances) <= chi2.ppf(0.8, 3)).mean() <= 0.9, kind


def test_a_pair_never_seen_has_what_its_classes_have_elsewhere():
    """A tall thing stands high beside whatever; the offsets of pairs are sums over classes here."""
    height = np.array([0.2, 0.4, 0.6, 0.8, 1.0, 1.2])
    rng = np.random.default_rng(4)
    scenes = [
        apart(tuple(rng.normal((0, 1, height[i] - height[j]), 0.05)), i, j)
        for i in range(V)
        for j in range(V)
        if i != j and (i, j) != (5, 0)
        for _ in range(20)
    ]
    mean, _, seen = of_pair(fit_offsets(scenes, V), 5, 0)
    assert seen == 0
    assert mean[2] > 0.4


def test_the_things_of_a_scene_weigh_one_together():
    crowd = scene([0] * 50 + [1], [(LEFT, 0, 1)])
    holds = np.zeros_like(crowd.instance_holds)
    holds[LEFT, :50, 50] = True
    positions = np.tile([0.0, 3.0, 0.0], (51, 1))
    positions[50] = 0.0
    crowd = replace(crowd, instance_holds=holds, instance_positions=positions)
    mean, _, scenes = of_pair(fit_offsets([*draws((0, 1, 0), 0.1, 49, 5), crowd], V))
    assert scenes == 50
    assert mean[1] == pytest.approx((49 * 1 + 3) / 50, abs=0.06)


@pytest.mark.parametrize(("count", "height", "spread"), [(100, 1.5, np.hypot(0.5, 0.1)), (5, 1, 0)])
def test_sources_have_equal_weights_unless_a_source_is_small(count, height, spread):
    """A source of 1,000 scenes has the mean 1, the other one the mean 2."""
    many = draws((0, 1, 0), 0.1, 1000, 6, source="many")
    few = draws((0, 2, 0), 0.1, count, 7, source="few")
    mean, std, scenes = of_pair(fit_offsets([*many, *few], V))
    assert scenes == 1000 + count
    assert mean[1] == pytest.approx(height, abs=0.05 if spread else 0.03)
    assert not spread or std[1] == pytest.approx(spread, abs=0.05)


def test_relations_and_objects_without_poses_mean_nothing():
    offsets = fit_offsets(draws(MEAN, STD, 20, 8), V)
    assert of_pair(offsets)[2] == 20
    assert of_pair(offsets, relation=ON_TOP)[2] == -1
    known, unknown = draws(MEAN, STD, 2, 9)
    unknown.instance_positions[0] = np.nan
    assert len(observed_offsets([known, unknown]).offset) == 1
    for one in (unknown, scene([0, 1], [(LEFT, 0, 1)])):
        assert fit_offsets([one], V) is None


def test_the_model_file_holds_the_statistics_exactly():
    vocabulary = rooms_vocabulary()
    offsets = fit_offsets(encode(generate_rooms(150, seed=0), vocabulary), len(vocabulary))
    check_stored_exactly(offsets, len(vocabulary), 0)
