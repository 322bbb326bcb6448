"""Compiled chains draw from the machine: by enumeration of small machines, and beside the tensors.

Stationarity is tested as in `test_gibbs`: states drawn from the enumerated joint, one sweep, and
the histogram against p. A class's relations to itself are left out, as the chains do.
"""

from __future__ import annotations

import copy
import math

import numpy as np
import pytest
import torch

from app.inference.chains import Conditions, SceneChains, random_stream
from app.inference.relations import ObservedRelations
from tests.enumeration.small_machines import (
    SMALL,
    check_frequencies,
    enumerate_joint,
    random_weights,
    small_machine,
)
from training.machines import MachineSpec, build
from training.machines.arrays import weights_of
from training.machines.chain_samples import ChainSamples, pack_scenes
from training.machines.gibbs import Clamp, run, sample_relations

CHAINS = 10_000
NAMES = [name for name, spec in SMALL.items() if spec.form == "local"]
NOTHING = np.zeros(0, dtype=np.int64)


def conditions(classes=(), relations=(), held=(), room=None):
    """Relations are (a, i, j, r), i and j places in classes."""
    a, i, j, r = np.array(sorted(relations), dtype=np.int64).reshape(-1, 4).T.copy()
    return Conditions(
        classes=np.array(classes, dtype=np.int64),
        log_counts=np.zeros(len(classes), dtype=np.float32),
        observed=ObservedRelations(a, i, j, r.astype(np.float32), np.ones(len(r), np.float32)),
        held=np.array(held, dtype=np.int64),
        held2=NOTHING,
        room=room,
    )


def rounded(name):
    """A small machine in float32, and the same weights in float64."""
    single = copy.deepcopy(small_machine(name)).float().requires_grad_(False)
    return single, copy.deepcopy(single).double()


def code(v, r, h1):
    """One integer for a state; r (A, V, V), its diagonal left out."""
    off = ~np.eye(r.shape[-1], dtype=bool)
    bits = np.concatenate([v, r[..., off].reshape(*v.shape[:-1], -1), h1], -1).astype(np.int64)
    return (bits << np.arange(bits.shape[-1])).sum(-1)


def unit(joint, a, i, j):
    """(states,) whether a relation is on; None where it has no unit."""
    e = joint.edges
    found = (e.relation[0] == a) & (e.subject[0] == i) & (e.object[0] == j)
    return joint.r[:, int(found.nonzero()[0])] > 0 if found.any() else None


def law(joint, given):
    """Codes and probabilities of the states where given, without r in one that implies.

    Relations of absent classes, which RBM and GBM have, are left out, as the chains do.
    """
    spec, e = joint.machine.spec, joint.edges
    r = np.zeros((len(joint.v), spec.A, spec.V, spec.V))
    if not spec.G:
        r[:, e.relation[0], e.subject[0], e.object[0]] = joint.r * e.ends_present(joint.v)
    codes = code(joint.v.numpy(), r, joint.h1.numpy())
    p = np.where(given.numpy(), joint.p.numpy(), 0.0)
    keys, which = np.unique(codes, return_inverse=True)
    return keys, np.bincount(which, p / p.sum())


def check_stationary(name, condition, given, room=None, beta=1.0):
    single, double = rounded(name)
    spec = double.spec
    joint = enumerate_joint(double if beta == 1 else double.scaled(beta), room)
    where = given(joint)
    keys, p = law(joint, where)
    chains = SceneChains(weights_of(single)).under(condition, 1 / beta)
    q = torch.where(where, joint.p, 0.0)
    picked = q.multinomial(CHAINS, True, generator=torch.Generator().manual_seed(1))
    starts = (units[picked].numpy().astype(np.uint8) for units in (joint.v, joint.h1, joint.h2))
    v, h1 = np.zeros((CHAINS, spec.V)), np.zeros((CHAINS, spec.H1))
    r = np.zeros((CHAINS, spec.A, spec.V, spec.V))
    stream = random_stream(5, 0)
    for chain, start in enumerate(zip(*starts, strict=True)):
        drawn = chains.move(*(units.copy() for units in start), 1, stream)
        if not spec.G:
            r[chain][:, drawn.classes[:, None], drawn.classes] = drawn.r
        v[chain, drawn.classes], h1[chain, drawn.h1] = 1, 1
    check_frequencies(code(v, r, h1), keys, p)


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize("beta", [pytest.param(1.0, marks=pytest.mark.slow), 0.5])
def test_chains_are_stationary(name, beta):
    check_stationary(name, conditions(room=1), lambda joint: joint.p >= 0, room=1, beta=beta)


@pytest.mark.slow
@pytest.mark.parametrize(("name", "r"), [*((name, 1) for name in NAMES), ("triway-local", 0)])
def test_chains_are_stationary_under_conditions(name, r):
    """Two classes present, a unit held on, one relation between them seen on or off."""

    def given(joint):
        seen = unit(joint, 0, 0, 1) == (r > 0)
        return (joint.v[:, :2] > 0).all(1) & (joint.h1[:, 1] > 0) & seen

    check_stationary(name, conditions([0, 1], [(0, 0, 1, r)], [1]), given)


# -- beside the tensors ------------------------------------------------------------------------

WIDE = MachineSpec("triway", V=40, A=4, H1=70, K=6, T=900, C=3, G=3, N=24, form="local")


@pytest.fixture(scope="module")
def wide():
    """Random weights, some six classes a scene."""
    generator = torch.Generator().manual_seed(0)
    machine = build(WIDE).requires_grad_(False)
    keys = torch.randperm(WIDE.A * WIDE.V**2, generator=generator)[: WIDE.T].sort().values
    triples = [keys // WIDE.V**2, keys // WIDE.V % WIDE.V, keys % WIDE.V]
    machine.set_triples(torch.stack(triples, 1))
    for name, parameter in machine.named_parameters():
        scale = {"W": 0.25, "M": 0.2, "gamma": 0.3, "B": 0.2}.get(name, 0.6)
        parameter.copy_(torch.randn(parameter.shape, generator=generator) * scale)
    machine.kappa.zero_()
    machine.b -= machine.W.sum(1) / 2 + 2
    machine.d -= 1
    machine.fantasies.copy_(pack_scenes((torch.rand(24, 40, generator=generator) < 0.15).float()))
    machine.fantasy_rooms.copy_(torch.arange(24) % 3 - 1)
    return machine.eval()


def torch_clamp(machine, rows, condition):
    classes = torch.from_numpy(condition.classes).expand(rows, -1)
    mask = torch.zeros(machine.spec.V, dtype=torch.bool)
    mask[classes[0]] = True
    held = torch.zeros(machine.spec.H1, dtype=torch.bool)
    held[torch.from_numpy(condition.held)] = True
    room = None if condition.room is None else torch.full((rows,), condition.room)
    observed = condition.observed
    if not len(observed.a):
        return mask, Clamp(v=mask, h1=held, room=room)
    shape = (machine.spec.A, len(condition.classes), len(condition.classes))
    seen, r = torch.zeros(shape, dtype=torch.bool), torch.zeros(shape)
    for a, i, j, on in zip(observed.a, observed.i, observed.j, observed.r, strict=True):
        seen[a, i, j], r[a, i, j] = True, float(on)
    seen, r = (table.view(1, -1).expand(rows, -1) for table in (seen, r))
    edges = machine.edges(classes)
    return mask, Clamp(v=mask, h1=held, edges=edges, r=r, observed=seen, room=room)


CONDITIONS = {
    "nothing": conditions(),
    "classes": conditions([3, 17, 30]),
    "relations": conditions([3, 17, 30], [(0, 0, 1, 1), (1, 1, 2, 1), (2, 2, 0, 0), (3, 0, 2, 1)]),
    "context": conditions([5], held=[2, 44]),
    "room": conditions([5], room=1),
    "room without a sample": conditions([5], room=2),
}


@pytest.mark.parametrize("name", CONDITIONS)
def test_samples_are_weighed_as_the_tensors_weigh_them(wide, name):
    condition, chains = CONDITIONS[name], SceneChains(weights_of(wide))
    mask, clamp = torch_clamp(wide, 1, condition)
    expected = ChainSamples(wide).log_weight(mask.float().unsqueeze(0), clamp).softmax(1)[0]
    np.testing.assert_allclose(chains.sample_weights(condition), expected, atol=1e-5)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "temperature"), [*((name, 1.0) for name in CONDITIONS), ("relations", 1.6)]
)
def test_long_chains_agree_with_those_of_tensors(wide, name, temperature):
    """Means over 600 chains each, of every class, every unit and the number of relations of each
    kind: 114 differences within 5.5 standard errors fail by chance with probability 5e-6."""
    condition, rows = CONDITIONS[name], 600
    mask, clamp = torch_clamp(wide, rows, condition)
    generator = torch.Generator().manual_seed(0)
    state = ChainSamples(wide).start(mask.float().repeat(rows, 1), generator, clamp)
    tempered = wide.scaled(1 / temperature)
    state = run(tempered, state, generator, 5, clamp, relations=False)
    state = run(tempered, state, generator, 1, clamp)
    grid = state.edges.unflatten(state.r * state.edges.ends_present(state.v))
    off = state.edges.subjects.unsqueeze(2) != state.edges.subjects.unsqueeze(1)
    counts = (grid * off.unsqueeze(1)).sum((2, 3))
    expected = torch.cat([state.v, state.h1, counts], 1).double().numpy()
    chains = SceneChains(weights_of(wide)).under(condition, temperature)
    found = np.zeros_like(expected)
    for chain, row in enumerate(found):
        drawn = chains.draw(6, random_stream(9, chain))
        row[drawn.classes] = 1
        row[40 + drawn.h1] = 1
        row[110:] = drawn.r.sum((1, 2)) - np.trace(drawn.r, axis1=1, axis2=2)
    error = np.sqrt((found.var(0) + expected.var(0)) / rows) + 1e-9
    assert (np.abs(found.mean(0) - expected.mean(0)) <= 5.5 * error + 1e-9).all()
    assert (found[:, condition.classes] == 1).all()
    assert (found[:, 40 + condition.held] == 1).all()


@pytest.mark.slow
@pytest.mark.parametrize(("layers", "temperature"), [(0, 1.0), (4, 1.6)])
def test_relations_that_imply_each_other_are_drawn_as_by_tensors(layers, temperature):
    """Three classes, one relation, strong implications: the law of its six units from 16,000 draws
    each. Two samples: total variation within its mean and 1e-9 of McDiarmid.

    How strictly implications hold is for the context to say, a second layer included.
    """
    rows = 16_000
    spec = MachineSpec("triway", V=3, A=1, H1=3, H2=layers, K=2, G=2, form="local")
    generator = torch.Generator().manual_seed(4)
    machine = random_weights(build(spec), generator)
    v, h1 = torch.ones(rows, 3), torch.tensor([[1.0, 0, 1]]).expand(rows, -1)
    _, r = sample_relations(machine.scaled(1 / temperature), v, h1, generator)
    chains = SceneChains(weights_of(machine)).under(conditions(), temperature)
    on, second = np.array([1, 0, 1], np.uint8), np.zeros(layers, np.uint8)
    off = ~np.eye(3, dtype=bool)
    bits = 1 << np.arange(6)
    expected = np.bincount(r.view(-1, 3, 3).numpy()[:, off].astype(int) @ bits, minlength=64) / rows
    found = np.zeros(64)
    for chain in range(rows):
        # No sweep: relations are drawn where the chain stands.
        stands = np.ones(3, np.uint8), on.copy(), second.copy()
        drawn = chains.move(*stands, 0, random_stream(0, chain))
        found[drawn.r[0][off] @ bits] += 1 / rows
    mean = 0.5 * np.sqrt(4 * expected * (1 - expected) / (math.pi * rows)).sum()
    slack = math.sqrt(9 * math.log(10) / rows)
    assert 0.5 * np.abs(found - expected).sum() < 1.1 * mean + slack
    # The test could not pass without implications.
    alone = 1 / (1 + np.exp(-drawn.logits[0][off] / temperature))
    independent = np.array(
        [np.prod(np.where(row >> np.arange(6) & 1, alone, 1 - alone)) for row in range(64)]
    )
    assert 0.5 * np.abs(found - independent).sum() > 3 * (mean + slack)


def test_other_machines_are_refused():
    for machine in (small_machine("triway-seed").float(), small_machine("triway-local")):
        weights = weights_of(machine)
        assert not SceneChains.supports(weights)
        with pytest.raises(ValueError, match="local form with float32 weights"):
            SceneChains(weights)
