"""The prior of possibility: its features, its limits, and its sum with the logits of a machine."""

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from app.inference.relation_units import RelationUnits, encode, relation_units
from app.model import Possibility
from app.model.possibility import IN, ON, OVER, UNDER, UnitsWithPrior, features, known_share
from app.scene.spatial_relations import ABOVE, CANONICAL, INSIDE, ON_TOP
from tests.questions.artifacts import PLACES, larger_artifact

# Sizes in metres; shares of floor, wall, ceiling, surface and inside; surface, container, carried.
THINGS = {
    "table": ((1.6, 0.8, 0.75), (0.9, 0.0, 0.0, 0.1, 0.0), (1.0, 0.0, 2.0)),
    "cup": ((0.08, 0.08, 0.1), (0.0, 0.0, 0.0, 0.75, 0.25), (0.0, 0.5, 0.0)),
    "oven": ((0.6, 0.6, 0.6), (0.5, 0.0, 0.0, 0.0, 0.5), (0.5, 1.0, 2.0)),
    "rug": ((2.0, 1.4, 0.02), (0.9, 0.1, 0.0, 0.0, 0.0), (1.0, 0.0, 1.0)),
    "lamp": ((0.4, 0.4, 0.5), (0.2, 0.1, 0.3, 0.4, 0.0), (0.0, 0.0, 1.0)),
    "unknown": ((0.5, 0.5, 0.5), (0.2,) * 5, (-1.0, -1.0, -1.0)),
    "unsized": ((math.nan,) * 3, (0.5, 0.0, 0.0, 0.5, 0.0), (1.0, 1.0, 1.0)),
}
NAMES, (SIZES, STANDS, TRAITS) = tuple(THINGS), zip(*THINGS.values(), strict=True)
V = len(NAMES)
WEIGHTS = np.random.default_rng(0).uniform(0.1, 1.0, (4, 4)).astype(np.float32)
PRIOR = Possibility(
    np.array(STANDS, np.float32), np.array(TRAITS, np.float32), np.full(V, 0.25, "f4"), WEIGHTS
)
ROWS = PRIOR.rows(np.arange(V), np.array(SIZES))


def phi(place, thing, other):
    rows = (ROWS[[NAMES.index(name)]] for name in (thing, other))
    return features(place, *rows)[0].tolist()


LEAST = -math.log(0.01)  # of a place where a thing never is


@pytest.mark.parametrize(
    ("place", "thing", "other", "expected"),
    [
        (ON, "cup", "table", (-math.log(0.75), 0.0, 0.0, 0.0)),
        (ON, "table", "cup", (-math.log(0.1), 1.0, math.log(1.28 / 0.0064), 2.0)),
        (ON, "table", "oven", (-math.log(0.1), 0.5, math.log(1.28 / 0.36), 0.0)),
        # A rug is flat, so what stands on the floor may stand on it.
        (ON, "table", "rug", (-math.log(0.9), 0.0, 0.0, 1.0)),
        (ON, "cup", "rug", (-math.log(0.75), 0.0, 0.0, 0.0)),
        (UNDER, "rug", "table", (-math.log(0.9), 0.0, math.log(2.8 / 1.28), 0.0)),
        (UNDER, "lamp", "table", (-math.log(0.2), 0.0, 0.0, 0.0)),
        (UNDER, "table", "lamp",
         (-math.log(0.9), 1.0, math.log(1.28 / 0.16) + math.log(0.75 / 0.5), 1.0)),
        (OVER, "lamp", "table", (-math.log(0.4), 0.0, 0.0, 0.0)),
        (OVER, "table", "lamp", (LEAST, 0.0, math.log(1.28 / 0.16), 1.0)),
        (IN, "cup", "oven", (-math.log(0.25), 0.0, 0.0, 0.0)),
        # The sides in order of size: .75, .8 and 1.6 m against three of .6 m.
        (IN, "table", "oven", (LEAST, 0.0, math.log(0.75 * 0.8 * 1.6 / 0.6**3), 0.0)),
        (IN, "lamp", "cup", (LEAST, 0.5, math.log(0.4 * 0.4 * 0.5 / (0.08 * 0.08 * 0.1)), 1.0)),
        # An unknown size shows nothing about the fit.
        (ON, "unsized", "cup", (-math.log(0.5), 1.0, 0.0, 1.0)),
        (IN, "table", "unsized", (LEAST, 0.0, 0.0, 1.0)),
    ],
)  # fmt: skip
def test_features_of_a_hand_computation(place, thing, other, expected):
    assert phi(place, thing, other) == pytest.approx(expected, abs=1e-5)


def test_the_prior_is_the_negative_weighted_sum_of_the_features():
    c = PRIOR.log_p(ROWS, ROWS)
    assert c.shape == (4, V, V)
    for place in range(4):
        for i, thing in enumerate(NAMES):
            for j, other in enumerate(NAMES):
                expected = -np.dot(WEIGHTS[place], phi(place, thing, other))
                if "unknown" in (thing, other):
                    expected = 0.0
                assert c[place, i, j] == pytest.approx(expected, abs=1e-6)


def test_classes_without_a_description_have_no_prior():
    assert PRIOR.is_described.tolist() == [name != "unknown" for name in NAMES]
    unknown = NAMES.index("unknown")
    c = PRIOR.log_p(ROWS, ROWS)
    assert not c[:, unknown].any()
    assert not c[:, :, unknown].any()
    described = [k for k in range(V) if k != unknown]
    assert (c[:, described][:, :, described] <= 0).all()


def test_holders_are_the_floor_the_wall_or_ceiling_and_objects():
    expected = [(f, w + c, s + i) for f, w, c, s, i in STANDS]
    assert PRIOR.holders == pytest.approx(np.array(expected), abs=1e-6)


extents = st.tuples(*[st.floats(0.01, 3.0)] * 3)
levels, carried = st.sampled_from([0.0, 0.5, 1.0]), st.sampled_from([0.0, 1.0, 2.0, 3.0])
descriptions = st.tuples(
    extents, st.tuples(*[st.floats(0.0, 1.0)] * 5), st.tuples(levels, levels, carried)
)


def log_p(thing, other):
    """The prior of all places of a described thing at another one."""
    sizes, stands, traits = (np.array(part) for part in zip(thing, other, strict=True))
    tables = (table.astype(np.float32) for table in (stands, traits, np.ones(2), WEIGHTS))
    prior = Possibility(*tables)
    rows = prior.rows(np.arange(2), sizes)
    return prior.log_p(rows[:1], rows[1:])[:, 0, 0]


@given(descriptions, descriptions, st.tuples(*[st.floats(1.0, 3.0)] * 3))
def test_a_larger_thing_is_never_more_possible(thing, other, factors):
    size, *rest = thing
    larger = tuple(np.multiply(size, factors).tolist()), *rest
    assert (log_p(larger, other) <= log_p(thing, other) + 1e-6).all()


@given(descriptions, descriptions, st.integers(0, 2), st.data())
def test_a_worse_holder_is_never_more_possible(thing, other, trait, data):
    """A worse surface or container, and one that is easier to carry than the thing."""
    size, stands, traits = other
    lower = data.draw((levels if trait < 2 else carried).filter(lambda x: x <= traits[trait]))
    worse = size, stands, tuple(lower if k == trait else x for k, x in enumerate(traits))
    before, after = log_p(thing, other), log_p(thing, worse)
    assert (after <= before + 1e-6).all()
    if trait == 0:
        assert after[[OVER, IN]].tolist() == before[[OVER, IN]].tolist()


@given(descriptions, descriptions, st.integers(0, 4), st.floats(0.0, 1.0))
def test_a_rarer_place_is_never_more_possible(thing, other, place, share):
    size, stands, traits = thing
    rarer = size, tuple(x * share if k == place else x for k, x in enumerate(stands)), traits
    assert (log_p(rarer, other) <= log_p(thing, other) + 1e-6).all()


@given(descriptions, descriptions, st.floats(1.0, 3.0))
def test_a_smaller_container_is_never_more_possible(thing, other, factor):
    """A lower surface may be flat, so the height of the holder stays, if a thing stands on it."""
    (x, y, z), *rest = other
    smaller = (x / factor, y / factor, z), *rest
    assert (log_p(thing, smaller) <= log_p(thing, other) + 1e-6).all()
    lower = (x / factor, y / factor, z / factor), *rest
    assert log_p(thing, lower)[IN] <= log_p(thing, other)[IN] + 1e-6


def test_the_known_share_grows_with_the_scenes():
    shares = known_share(np.array([0.0, 2.0, 8.0, math.inf]))
    assert shares == pytest.approx([0.0, 0.5, 0.8, 1.0])


# -------------------------------------------------------------------------- logits with the prior


def with_prior(name):
    """An artifact of nine classes with the descriptions of `THINGS`, some of them twice."""
    artifact = larger_artifact(name)
    rows = np.resize(np.arange(V), artifact.spec.V)
    tables = (np.array(part, np.float32)[rows] for part in (STANDS, TRAITS, np.full(V, 0.25)))
    return replace(artifact, possibility=Possibility(*tables, WEIGHTS))


def expected_change(artifact, a, i, j):
    """The change of a logit between classes i and j, by the formula."""
    c = artifact.possibility.log_p(artifact.descriptions, artifact.descriptions)
    if a < ON_TOP:
        return 0.0
    prior = c[OVER if a == ABOVE else IN, i, j]
    if a == ON_TOP:
        # "i on top of j" may mean j under i, in one of ten statements.
        prior = min(np.logaddexp(c[ON, i, j], -2.3 + c[UNDER, j, i]), 0.0)
    size = artifact.spec.V
    n = dict(zip(PLACES.triple.tolist(), PLACES.triple_scenes.tolist(), strict=True)).get(
        (a * size + i) * size + j, 0.0
    )
    return 0.25 * prior * 2.0 / (n + 2.0)


class ByHand(RelationUnits):
    """The units of a machine, whose mean logits change by the formula."""

    def __init__(self, artifact):
        super().__init__(artifact.weights)
        self._artifact, self._plain = artifact, relation_units(artifact.weights)

    def moments(self, means, pairs, chosen, *, sampled=False):
        mean, spread = self._plain.moments(means, pairs, chosen, sampled=sampled)
        subjects, others = pairs.classes[pairs.i], pairs.classes[pairs.j]
        for b, row, p in np.ndindex(mean.shape):
            pair = subjects[b, p], others[b, p]
            mean[b, row, p] += expected_change(self._artifact, chosen.start + row, *pair)
        return mean, spread


CLASSES = np.array([0, 1, 2, 3, 5, 7])
NAMES_OF_MACHINES = ("rbm", "triway", "triway-states", "triway-implications")


@pytest.mark.parametrize("name", NAMES_OF_MACHINES)
def test_logits_of_a_scene_are_those_of_the_machine_and_the_prior(name):
    artifact = with_prior(name)
    n = len(CLASSES)
    scene = encode(artifact.weights, CLASSES, np.ones(n, "f4"), np.zeros(n, "f4"))
    plain = relation_units(artifact.weights)
    assert isinstance(artifact.relation_units, UnitsWithPrior)
    before, after = plain.logits(scene), artifact.relation_units.logits(scene)
    assert np.array_equal(before.spread, after.spread)
    changes = np.array(
        [[[expected_change(artifact, a, i, j) for j in CLASSES] for i in CLASSES]
         for a in range(len(CANONICAL))]
    )  # fmt: skip
    # Relations without a unit have a logit far below all others.
    assert after.mean - before.mean == pytest.approx(changes, abs=2e-3)
    assert (changes[ON_TOP:] < -0.1).any()


@pytest.mark.parametrize("name", NAMES_OF_MACHINES)
@pytest.mark.parametrize("only", [None, ON_TOP, ABOVE, INSIDE, 0])
def test_placements_are_those_of_the_machine_and_the_prior(name, only):
    """Both directions, and also one relation alone, as for a place that a request names."""
    artifact = with_prior(name)
    listed, candidates = CLASSES[:3], CLASSES[3:]
    n = len(listed)
    scene = encode(artifact.weights, listed, np.ones(n, "f4"), np.zeros(n, "f4"))
    anchors = np.arange(n)
    by_hand = ByHand(artifact).placement_log_odds(scene, candidates, anchors, only)
    plain = relation_units(artifact.weights).placement_log_odds(scene, candidates, anchors, only)
    found = artifact.relation_units.placement_log_odds(scene, candidates, anchors, only)
    for one, two, three in zip(found, by_hand, plain, strict=True):
        assert one == pytest.approx(two, abs=1e-4)
        assert (one <= three + 1e-4).all()
        if only == 0 or name != "rbm":  # the RBM has no unit of some relations
            assert (only == 0) == np.array_equal(one, three)


def test_the_weights_of_implications_stay_those_of_the_machine():
    artifact = with_prior("triway-implications")
    x = np.random.default_rng(0).normal(size=artifact.spec.H1).astype(np.float32)
    plain = relation_units(artifact.weights)
    for beta in (1.0, 0.5):
        one, two = (u.implication_weights(x, beta) for u in (plain, artifact.relation_units))
        assert np.array_equal(one, two)
    assert with_prior("rbm").relation_units.implication_weights(x) is None


def test_without_a_description_of_any_class_the_logits_are_those_of_the_machine():
    artifact = with_prior("triway")
    assert replace(artifact, places=None).possibility is not None
    assert not isinstance(replace(artifact, places=None).relation_units, UnitsWithPrior)
    assert not isinstance(replace(artifact, possibility=None).relation_units, UnitsWithPrior)
