"""The posterior of unlisted classes against enumeration."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from app.inference.completions import Completions
from app.inference.objects import ContextScorer
from tests.enumeration.small_machines import binary
from training.machines import MachineSpec, build
from training.machines.arrays import weights_of
from training.machines.chain_samples import pack_scenes

SPEC = MachineSpec("triway", V=7, A=1, H1=4, C=2, K=1, form="local")
NOTHING = np.zeros(SPEC.V, dtype=bool)
COVERAGES = [0.0, 0.3, 0.5, 0.8, 0.97]
LISTED = [[], [0], [2, 5], [0, 1, 3, 6]]
# Of 2^14 completions from 2^14 samples, independent draws would have a standard error below .004,
# times the root of the spread of the weights.
MANY, TOLERANCE = 1 << 14, 0.015


def machine_of(samples, rooms=(None,), seed=0):
    """A float32 machine whose stored samples are drawn exactly, as many under each room type."""
    generator = torch.Generator().manual_seed(seed)
    machine = build(replace(SPEC, N=samples * len(rooms)))
    with torch.no_grad():
        for name in ("W", "b", "c1", "Q"):
            parameter = getattr(machine, name)
            parameter.copy_(torch.randn(parameter.shape, generator=generator) * 1.2)
        machine.b -= 1
        drawn = []
        for room in rooms:
            p = joint(machine, room).sum(1)
            drawn.append(p.multinomial(samples, replacement=True, generator=generator))
        machine.fantasies.copy_(pack_scenes(binary(SPEC.V)[torch.cat(drawn)]))
        codes = [-1 if room is None else room for room in rooms]
        machine.fantasy_rooms.copy_(torch.tensor(codes).repeat_interleave(samples))
    return machine.eval().requires_grad_(False)


def joint(machine, room=None):
    """p(v, h1), (2^V, 2^H1)."""
    v, h = binary(SPEC.V), binary(SPEC.H1)
    bias = machine.c1.double() if room is None else (machine.c1 + machine.Q[room]).double()
    log_p = (v @ machine.b.double())[:, None] + h @ bias + v @ machine.W.double() @ h.T
    return (log_p - log_p.logsumexp((0, 1))).exp()


def exactly(machine, listed, coverage, room=None):
    """p(v_i = 1 | L), (V,): the sum over all v that hold L."""
    v, p = binary(SPEC.V), joint(machine, room).sum(1)
    fits = (v[:, listed] > 0).all(1)
    p = p * fits * (1 - coverage) ** (v.sum(1) - len(listed))
    return ((p @ v) / p.sum()).numpy()


def prepared(machine, structure, *count):
    weights = weights_of(machine)
    return Completions(weights, structure, ContextScorer(weights["W"]), *count)


def ask(completions, machine, listed, coverage, room=None):
    bias = machine.c1 if room is None else machine.c1 + machine.Q[room]
    y = (bias + machine.W[listed].sum(0)).numpy()
    ones = np.ones(len(listed), dtype=np.float32)
    classes = np.array(listed, dtype=np.int64)
    log_odds = completions.log_odds(y, classes, ones, coverage, room)
    return 1 / (1 + np.exp(-log_odds.astype(np.float64)))


@pytest.fixture(scope="module")
def many():
    machine = machine_of(MANY)
    return machine, prepared(machine, NOTHING, MANY)


@pytest.mark.parametrize("listed", LISTED)
@pytest.mark.parametrize("coverage", COVERAGES)
def test_many_completions_are_the_posterior(many, listed, coverage):
    machine, completions = many
    rest = np.setdiff1d(np.arange(SPEC.V), listed)
    found = ask(completions, machine, listed, coverage)[rest]
    np.testing.assert_allclose(found, exactly(machine, listed, coverage)[rest], atol=TOLERANCE)


@pytest.mark.parametrize("rooms", [(None,), (0, 1), (None, 0, 1)])
def test_a_room_type_counts_whatever_the_samples_were_drawn_under(rooms):
    machine = machine_of(MANY // len(rooms), rooms)
    completions = prepared(machine, NOTHING, MANY)
    for room in (0, 1):
        truth = exactly(machine, [2], 0.5, room)
        found = ask(completions, machine, [2], 0.5, room)
        rest = np.delete(np.arange(SPEC.V), 2)
        np.testing.assert_allclose(found[rest], truth[rest], atol=TOLERANCE)
    assert np.abs(exactly(machine, [2], 0.5, 0) - exactly(machine, [2], 0.5, 1)).max() > 0.1


def test_rooms_of_very_different_strength_give_finite_odds():
    """Both types hold all context units on, with biases of 300 and 1200: all scenes are alike."""
    machine = machine_of(64, (0, 1))
    machine.Q[0], machine.Q[1] = 300.0, 1200.0
    found = [ask(prepared(machine, NOTHING), machine, [2], 0.5, room) for room in (0, 1)]
    assert np.isfinite(found).all()
    np.testing.assert_allclose(*found, atol=1e-6)


def test_the_same_scene_gets_the_same_bits():
    machine = machine_of(64)
    first = ask(prepared(machine, NOTHING), machine, [1, 4], 0.5)
    again = prepared(machine, NOTHING)
    ask(again, machine, [0], 0.3)
    np.testing.assert_array_equal(ask(again, machine, [1, 4], 0.5), first)


def test_structure_is_never_added_and_tells_nothing_where_it_is_unlisted():
    """So the answer about all other classes is that of the machine with it summed out of the
    weights and absent in the completions."""
    machine = machine_of(512)
    structure = NOTHING.copy()
    structure[3] = True
    plain = prepared(machine, structure, 64)
    raised = machine_of(512)
    raised.b.data[3] += 5
    other = prepared(raised, structure, 64)
    rest = np.delete(np.arange(SPEC.V), [0, 3])
    np.testing.assert_array_equal(
        ask(plain, machine, [0], 0.5)[rest], ask(other, raised, [0], 0.5)[rest]
    )


def test_a_doubtful_class_weighs_less():
    machine = machine_of(MANY)
    completions = prepared(machine, NOTHING, 1024)
    bias, one = machine.c1.numpy(), np.array([2])
    found = [
        completions.log_odds(bias + g * machine.W[2].numpy(), one, np.array([g], np.float32), 0.5)
        for g in (0.0, 0.5, 1.0)
    ]
    change = np.abs(np.diff(np.delete(np.array(found), 2, axis=1), axis=0)).max(1)
    assert (change > 0.02).all()


def test_other_machines_have_no_completions():
    assert not Completions.supports(weights_of(build(SPEC)))
    heavy = machine_of(4)
    heavy.W.data[0, 0] = 100.0
    assert not Completions.supports(weights_of(heavy))
    with pytest.raises(ValueError, match="stored samples"):
        prepared(heavy, NOTHING)
