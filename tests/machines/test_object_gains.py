"""Log-odds of classes and room types in the service, against the tensors in float64."""

import numpy as np
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from app.inference.objects import LARGEST_WEIGHT, HiddenLogOdds, ObjectScorer
from app.inference.relation_units import encode
from tests.enumeration.small_machines import random_weights
from training.machines import MachineSpec, build, weights_of

SEEDS = st.integers(0, 2**32)
# The largest |w| decides how many factors share a log.
WEIGHTS = st.sampled_from([0.0, 1e-3, 1.0, 3.0, 5.0, 12.0, 17.0, 39.9, LARGEST_WEIGHT])
LOGITS = st.sampled_from([0.0, 1.0, 10.0, 17.0, 60.0, 88.0, 95.0, 104.0, 1e4])


def uniform(shape, largest, generator):
    return (2 * torch.rand(shape, generator=generator) - 1) * largest


@given(
    rows=st.integers(1, 40),
    units=st.integers(1, 40),
    states=st.sampled_from([2, 3, 4, 5, 32]),
    scenes=st.integers(1, 4),
    weight=WEIGHTS,
    logit=LOGITS,
    are_corners=st.booleans(),
    seed=SEEDS,
)
def test_gain_is_exact_to_float32_rounding(
    rows, units, states, scenes, weight, logit, are_corners, seed
):
    """At the corners every weight is ±weight and every logit ±logit, so that whole groups of
    factors are extreme at once."""
    generator = torch.Generator().manual_seed(seed)
    shape = units * (states - 1)
    w, x = uniform((rows, shape), weight, generator), uniform((scenes, shape), logit, generator)
    if are_corners:
        w, x = w.sign() * weight, x.sign() * logit
    machine = build(MachineSpec("rbm", V=1, A=1, units=units, states=states))
    for weights in (w, w.abs(), -w.abs()):
        gains = HiddenLogOdds(weights.numpy(), states)
        for logits in (x, x.abs(), -x.abs()):
            gain = torch.from_numpy(gains(logits.numpy())).double()
            # Each factor is good to some float32 roundings, and there are as many as units.
            close = {"rtol": 1e-5, "atol": 5e-7 * units}
            exact = machine.hidden_log_odds(logits.double(), weights.double())
            torch.testing.assert_close(gain, exact, **close)


def test_many_rows_are_computed_alike():
    """Rows beyond one tile of 800 have the bits that they have alone."""
    generator = torch.Generator().manual_seed(0)
    w, x = uniform((1700, 40), 2.0, generator).numpy(), uniform((3, 40), 2.0, generator).numpy()
    gain = HiddenLogOdds(w, 5)(x)
    for row in (0, 799, 800, 1599, 1600, 1699):
        np.testing.assert_array_equal(HiddenLogOdds(w[row : row + 1], 5)(x)[:, 0], gain[:, row])
    np.testing.assert_array_equal(HiddenLogOdds(w, 5)(x[1:2])[0], gain[1])


V, C = 14, 3
SPECS = {
    "binary": MachineSpec("rbm", V=V, A=1, units=30, C=C, profiles=3),
    "states": MachineSpec(
        "triway", V=V, A=1, units=5, states=8, C=C, K=1, profiles=3, coupled=True
    ),
    "uncoupled": MachineSpec("gbm", V=V, A=1, units=6, states=4, C=C, profiles=3),
}


class Case:
    """A machine, some listed classes with probabilities, a room type and a profile."""

    def __init__(self, name, seed):
        generator = torch.Generator().manual_seed(seed)
        self.machine = random_weights(build(SPECS[name]), generator)
        weights = weights_of(self.machine)
        self.machine.double()
        n = int(torch.randint(1, 9, (), generator=generator))
        self.classes = torch.randperm(V, generator=generator)[:n].numpy()
        self.presence = torch.rand(n, generator=generator).numpy()
        self.room = int(torch.randint(-1, C, (), generator=generator))
        self.source = int(torch.randint(-1, 3, (), generator=generator))
        self.profile = None if self.source < 0 else self.source
        self.scorer = ObjectScorer(weights)
        room = None if self.room < 0 else self.room
        self.context = encode(weights, self.classes, self.presence, self.presence, room)
        self.v = torch.zeros(1, V).double()
        self.v[0, self.classes] = torch.from_numpy(self.presence).double()

    def log_odds(self, *without):
        """By the tensors, (V,), with the classes but those at some rows."""
        v = self.v.index_fill(1, torch.from_numpy(self.classes[list(without)]), 0)
        room, source = torch.tensor([self.room]), torch.tensor([self.source])
        return self.machine.object_log_odds(v, room=room, source=source)[0].numpy()


def close(found, expected, atol=2e-4):
    np.testing.assert_allclose(found, expected, rtol=1e-4, atol=atol)


@given(name=st.sampled_from(sorted(SPECS)), seed=SEEDS)
def test_log_odds_equal_the_tensors(name, seed):
    """Of absent classes, and of each listed class given the others, computed without it."""
    case = Case(name, seed)
    scene, absent = (case.classes, case.presence), np.setdiff1d(np.arange(V), case.classes)
    room = None if case.room < 0 else case.room
    found = case.scorer.absent(case.context.x, *scene, case.profile, 0.15, room)
    kappa = case.machine.kappa.numpy()
    close(found[absent], (case.log_odds() + kappa[0])[absent])
    found, _ = case.scorer.given_rest(case.context, case.profile, room)
    close(found, [case.log_odds(k)[i] + kappa[-1, i] for k, i in enumerate(case.classes)])
    if case.room < 0:
        scene = case.context.x[None], case.classes, case.presence[None], case.profile
        expected = case.machine.room_log_p(case.v, torch.tensor([case.source]))
        close(case.scorer.room_log_p(*scene)[0], expected[0])


@settings(max_examples=40)
@given(name=st.sampled_from(sorted(SPECS)), seed=SEEDS)
def test_reasons_are_differences_of_log_odds(name, seed):
    """With class j minus without class j, recomputed; of class i itself, 0."""
    case = Case(name, seed)
    _, found = case.scorer.given_rest(case.context, case.profile, explained=True)
    expected = np.zeros_like(found)
    for k, i in enumerate(case.classes):
        for j in set(range(len(case.classes))) - {k}:
            expected[k, j] = case.log_odds(k)[i] - case.log_odds(k, j)[i]
    close(found, expected)
    candidates = np.setdiff1d(np.arange(V), case.classes)[::3]
    found = case.scorer.reasons_for_absent(case.context, case.profile, candidates)
    each = [case.log_odds() - case.log_odds(j) for j in range(len(case.classes))]
    close(found, np.array(each).T[candidates])
