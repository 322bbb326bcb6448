"""Gradients of the objectives: against the exact log-likelihood, and every objective learns.

All objectives in the registry run on the same tiny scenes.
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from torch.nn.functional import logsigmoid

from tests.enumeration.small_machines import (
    SMALL,
    draw_states,
    enumerate_joint,
    small_machine,
)
from training.datasets.batches import Batch, relation_units
from training.fit.configuration import ObjectiveConfig
from training.fit.machine_scores import MachineScore, relation_score
from training.fit.objectives import OBJECTIVES
from training.fit.objectives.composite import mask_one_class, unlisted_off
from training.fit.objectives.contrastive import centre_gradients, energy_difference
from training.machines import build
from training.machines.log_odds import object_log_odds
from training.machines.machine import State
from training.machines.mean_field import Evidence

SAMPLES = 200_000


def gradients(machine):
    return {n: p.grad.clone() for n, p in machine.named_parameters() if p.grad is not None}


def exact_log_partition(machine, joint):
    """log Z with its graph."""
    energy = machine.energy(joint.v, joint.r, joint.h1, joint.h2, joint.edges)
    return (-energy).logsumexp(0)


@pytest.mark.parametrize("name", SMALL)
def test_energy_difference_estimates_the_exact_gradient(name):
    """Data and model terms from exact samples: each entry within 6 standard errors (< 1e-6 by
    chance)."""
    machine = small_machine(name).requires_grad_(True)
    if machine.spec.variant == "triway":
        machine.kappa.requires_grad_(False)
    joint = enumerate_joint(machine)
    v = torch.ones(machine.spec.V).double()
    given = (joint.v == v).all(1)
    energy = machine.energy(joint.v, joint.r, joint.h1, joint.h2, joint.edges)
    exact = (-energy).logsumexp(0) - (-energy[given]).logsumexp(0)
    exact.backward()
    wanted = gradients(machine)
    machine.zero_grad()
    generator = torch.Generator().manual_seed(3)
    with torch.no_grad():
        data = draw_states(joint, SAMPLES, generator, given)
        model = draw_states(joint, SAMPLES, generator)
    room = torch.full((SAMPLES,), -1)
    unobserved = torch.zeros(SAMPLES, joint.r.shape[1], dtype=torch.bool)
    energy_difference(machine, data, unobserved, model, room, room).backward()
    for parameter, value in gradients(machine).items():
        # Sufficient statistics are products of units, within [-1, 1] times the weights (< 4 here).
        tolerance = 6 * 4 / SAMPLES**0.5
        difference = (value - wanted.get(parameter, torch.zeros_like(value))).abs()
        assert bool((difference < tolerance).all()), parameter


def test_observed_relations_enter_the_local_form_by_their_likelihood():
    """-log p(r | v) at fixed h1 adds exactly its gradient to the object part's."""
    machine = small_machine("triway-local").requires_grad_(True)
    joint = enumerate_joint(machine)
    state = State(joint.v[:50], joint.h1[:50], joint.h2[:50], joint.r[:50], joint.edges)
    state = State(*(getattr(state, n) for n in ("v", "h1", "h2", "r")),
                  machine.edges(torch.arange(2).expand(50, -1)))  # fmt: skip
    room = torch.full((50,), -1)
    everything = torch.ones(50, joint.r.shape[1], dtype=torch.bool)
    loss = energy_difference(machine, state, everything, state, room, room)
    logits = machine.relation_logits(state.edges, state.v, state.h1)
    gate = machine.gate(state.edges, state.v)
    nll = -(torch.distributions.Bernoulli(logits=logits).log_prob(state.r) * gate).sum(1).mean()
    torch.testing.assert_close(loss, nll)


@pytest.mark.parametrize("name", SMALL)
def test_one_step_of_contrastive_divergence_moves_the_context_biases(name):
    """The model term has a context of its own: where data and model differ, so does <h1>."""
    machine = toy_machine(name)
    with torch.no_grad():
        machine.W.mul_(20.0)  # what is drawn instead of the data reaches h1
    config = ObjectiveConfig(name="contrastive_divergence", k=1)
    objective = OBJECTIVES["contrastive_divergence"](config, machine)
    objective.loss(machine, toy_batch(), torch.Generator().manual_seed(0)).backward()
    assert float(machine.c1.grad.abs().max()) > 0.01


def test_centred_gradient_is_the_gradient_in_centred_coordinates():
    """Moving along it is the plain gradient of the machine written in (v - μ)(h - λ)."""
    machine = small_machine("gbm").requires_grad_(True)
    joint = enumerate_joint(machine)
    mu, l1, l2 = (torch.full((n,), x).double() for n, x in ((2, 0.3), (2, 0.6), (2, 0.2)))
    at = [joint.v[7:8], joint.r[7:8], joint.h1[7:8], joint.h2[7:8], joint.edges]
    (machine.energy(*at).sum() + exact_log_partition(machine, joint)).backward()
    centre_gradients(machine, mu, l1, l2)
    centred = gradients(machine)
    # In centred coordinates b' = b + W λ1, c1' = c1 + W'μ + J λ2, c2' = c2 + J'λ1.
    W = machine.W.detach().clone().requires_grad_(True)
    J = machine.J.detach().clone().requires_grad_(True)
    b = (machine.b + machine.W @ l1).detach().requires_grad_(True)
    c1 = (machine.c1 + mu @ machine.W + machine.J @ l2).detach().requires_grad_(True)
    c2 = (machine.c2 + l1 @ machine.J).detach().requires_grad_(True)
    plain = {"b": b - W @ l1, "c1": c1 - mu @ W - J @ l2, "c2": c2 - l1 @ J, "W": W, "J": J}
    for name, value in plain.items():
        machine._parameters[name] = value
    (machine.energy(*at).sum() + exact_log_partition(machine, joint)).backward()
    for name, leaf in (("W", W), ("J", J)):
        torch.testing.assert_close(centred[name], leaf.grad)
    # A step along (g_b', g_c1', g_c2', g_W, g_J) moves the plain biases by the centred ones.
    torch.testing.assert_close(centred["b"], b.grad - W.grad @ l1)
    torch.testing.assert_close(centred["c1"], c1.grad - mu @ W.grad - J.grad @ l2)
    torch.testing.assert_close(centred["c2"], c2.grad - l1 @ J.grad)


def toy_batch(size=24, seed=0):
    """Scenes over 5 classes: {0,1,2} or {0,3,4}, class 1 left of 2 and 3 on-top 4; A = 2."""
    rng = np.random.default_rng(seed)
    v = torch.zeros(size, 5)
    classes = torch.full((size, 3), -1)
    holds = torch.zeros(size, 2, 3, 3)
    for row, kind in enumerate(rng.integers(2, size=size)):
        present = [0, 1, 2] if kind else [0, 3, 4]
        v[row, present] = 1
        classes[row] = torch.tensor(present)
        holds[row, 0 if kind else 1, 1, 2] = 1
    observed = torch.ones(size, 2, 3, 3, dtype=torch.bool)
    observed[: size // 3] = False
    holds[: size // 3] = 0
    room, source = torch.full((size,), -1), torch.zeros(size, dtype=torch.int64)
    return Batch(v, classes, torch.ones_like(classes), holds, observed, room, source)


TOY_TRIPLES = torch.tensor([[0, 1, 2], [1, 3, 4]])


def toy_machine(name):
    spec = SMALL[name]
    changes = {"V": 5, "A": 2, "T": 2, "H1": 6, "C": 0}
    machine = build(type(spec).from_dict({**spec.to_dict(), **changes}))
    return machine.set_triples(TOY_TRIPLES).initialise(torch.Generator().manual_seed(1), 0.1)


@pytest.mark.slow
@pytest.mark.parametrize("objective", [name for name in OBJECTIVES if name != "relations"])
# `toy_machine` makes rbm-three-classes the same as rbm.
@pytest.mark.parametrize("name", [name for name in SMALL if name != "rbm-three-classes"])
def test_every_objective_trains_every_machine(objective, name):
    """After 100 updates the missing class and the relation of the toy scenes are known."""
    machine = toy_machine(name)
    generator = torch.Generator().manual_seed(0)
    config = ObjectiveConfig(name=objective, k=3, chains=64, relation_weight=1.0)
    target = OBJECTIVES[objective](config, machine)
    optimiser = torch.optim.Adam(
        [p for n, p in machine.named_parameters() if n != "kappa" and p.numel()], lr=0.1
    )
    # The rate falls to zero: a persistent chain at a constant one never settles.
    schedule = torch.optim.lr_scheduler.LinearLR(optimiser, 1.0, 0.0, total_iters=100)
    batch = toy_batch()
    for _ in range(100):
        loss = target.loss(machine, batch, generator)
        optimiser.zero_grad()
        loss.backward()
        target.adjust_gradients(machine)
        optimiser.step()
        schedule.step()
    v = torch.tensor([[1.0, 1, 0, 0, 0], [1, 0, 0, 0, 1]])
    log_odds = MachineScore(machine)(v)
    assert log_odds[0, 2] > log_odds[0, 3:].max()
    assert log_odds[1, 3] > log_odds[1, 1:3].max()
    both = Batch(*(getattr(batch, n)[-8:] for n in batch.__dataclass_fields__))
    scores = relation_score(machine)(both)
    assert bool((scores[both.holds > 0] > 0).all())
    assert bool((scores[(both.holds == 0)][torch.isfinite(scores[both.holds == 0])] < 0).all())


@pytest.mark.parametrize("name", SMALL)
def test_relation_units_say_the_same_in_every_layout(name):
    machine = toy_machine(name)
    batch = toy_batch()
    edges, r, observed = relation_units(machine, batch)
    for row in range(len(batch)):
        triples = {
            tuple(int(getattr(edges, end)[row if len(edges.valid) > 1 else 0, e])
                  for end in ("relation", "subject", "object"))
            for e in r[row].nonzero().flatten()
        }  # fmt: skip
        expected = {
            (int(a), int(batch.classes[row, x]), int(batch.classes[row, y]))
            for a, x, y in batch.holds[row].nonzero()
        }
        assert triples == expected
        assert bool((r[row] <= observed[row].float()).all())


def test_masking_takes_one_class_out_and_never_structure():
    batch = toy_batch()
    structure = torch.tensor([True, False, False, False, False])
    masked = mask_one_class(batch, structure, torch.Generator().manual_seed(0))
    assert not bool((masked.target == 0).any())
    assert bool((masked.v.sum(1) == 2).all())
    assert bool((masked.removable == 2).all())
    assert not bool(masked.absent[:, 0].any())
    assert bool(masked.absent.gather(1, masked.target.unsqueeze(1)).all())


def test_composite_likelihood_ranks_the_removed_class_and_separates_present_from_absent():
    """The loss without relations and chains, scene by scene."""
    dropouts = dict.fromkeys(("object_dropout", "structure_dropout", "room_dropout"), 0.0)
    config = ObjectiveConfig(name="composite", presence_weight=0.7, relation_weight=0.0, **dropouts)
    machine, batch = toy_machine("triway-local"), toy_batch()
    generators = [torch.Generator().manual_seed(4) for _ in range(2)]
    found = OBJECTIVES["composite"](config, machine).loss(machine, batch, generators[0])
    masked = mask_one_class(batch, torch.zeros(5, dtype=torch.bool), generators[1])
    total = 0.0
    for v, i, absent, n in zip(
        masked.v, masked.target, masked.absent, masked.removable, strict=True
    ):
        odds = object_log_odds(machine, Evidence(v[None]))[0].detach()
        others = absent & (torch.arange(5) != i)
        presence = -n * logsigmoid(odds[i]) - logsigmoid(-odds[others]).sum()
        total += odds[absent].logsumexp(0) - odds[i] + 0.7 * presence
    assert float(found.detach()) == pytest.approx(float(total) / len(masked.v), rel=1e-4)


def test_unlisted_relations_can_count_as_off():
    """Between things, not structure; scenes that nobody annotated teach nothing either way."""
    batch = toy_batch()
    batch = replace(batch, observed=batch.holds > 0)
    structure = torch.tensor([True, False, False, False, False])
    off = unlisted_off(batch, structure)
    pairs = torch.zeros(3, 3, dtype=torch.bool)
    pairs[1, 2] = pairs[2, 1] = True
    assert torch.equal(off.observed, pairs.expand_as(off.observed))
    assert torch.equal(off.holds, batch.holds)
    machine = toy_machine("triway-local")
    losses = []
    for unlisted in ("unobserved", "off"):
        config = ObjectiveConfig(name="composite", unlisted=unlisted, room_dropout=0.0)
        target = OBJECTIVES["composite"](config, machine, structure)
        loss = target.relation_part(machine, batch, torch.Generator().manual_seed(0))
        losses.append(float(loss.detach()))
    # 16 of 24 scenes are annotated; each of their units is near even odds here.
    even = 16 / 24 * math.log(2)
    assert losses[0] == pytest.approx(even, rel=0.1)
    assert losses[1] == pytest.approx(4 * even, rel=0.1)
