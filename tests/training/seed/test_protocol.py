"""The seed paper's protocol: what is drawn, what leaks, and what doing nothing scores."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from tests.questions.artifacts import LARGER
from tests.training.evaluation.scenes import larger_machine, random_scenes, scene, tensors
from training.datasets.batches import relation_units
from training.evaluation.model import Model
from training.evaluation.setting import Setting
from training.machines.bernoulli import bernoulli
from training.machines.mean_field import Evidence, mean_field
from training.seed.protocol import (
    SEED_TASKS,
    draw_relations,
    reconstruction_after_addition,
    relations_switched_on,
    removed_switched_on,
    switch_on_probability,
)

V = LARGER["triway-local"].V
NO_STRUCTURE = torch.zeros(V, dtype=torch.bool)
DATA = tensors(random_scenes(60, V), V)
SETTING = Setting(DATA, NO_STRUCTURE)
MACHINES = pytest.mark.parametrize("name", list(LARGER))


def model(name: str) -> Model:
    return Model(machine=larger_machine(name))


def rng() -> torch.Generator:
    return torch.Generator().manual_seed(0)


@MACHINES
def test_every_machine_is_asked_every_question(name):
    for task in SEED_TASKS.values():
        outcome = task(model(name), SETTING)
        assert all(np.isfinite(metric.value) for metric in outcome.metrics.values())
        again = task(model(name), SETTING)
        for metric, value in outcome.metrics.items():
            assert again.metrics[metric].value == value.value


def test_a_model_without_a_machine_has_no_outcome():
    assert [task(Model(), SETTING) for task in SEED_TASKS.values()] == [None] * 3


@MACHINES
def test_shares_are_what_was_drawn(name):
    """With every relation certain, all labelled ones of known units are on; with none, none is."""
    machine = larger_machine(name)
    shares = {}
    for bias in (-1e4, 1e4):
        machine.get_parameter("d").data.fill_(bias)
        outcome = relations_switched_on(Model(machine=machine), SETTING)
        shares[bias] = outcome.metrics["labelled relations switched on"].value
        on = outcome.metrics["relations switched on per scene"].value
        assert (on > 0) is (bias > 0)
    assert shares[-1e4] == 0
    # A machine without gates has units for the triples of its table alone.
    assert shares[1e4] == 1 if machine.spec.variant == "triway" else 0 < shares[1e4] < 1


def test_only_objects_that_are_there_are_related_in_a_gated_machine():
    machine = larger_machine("triway-local")
    machine.get_parameter("d").data.fill_(1e4)
    batch = DATA.batch(torch.arange(10))
    total, grid = draw_relations(machine, batch, rng())
    n = (batch.classes >= 0).sum(1)
    assert total.tolist() == (machine.spec.A * n**2).tolist()
    assert grid.sum((1, 2, 3)).tolist() == total.tolist()


@pytest.mark.parametrize("name", ["triway-seed", "triway-local"])
def test_relations_left_on_hold_their_object(name):
    """The leak: whatever the weights, the object of a relation that is on is on."""
    machine = larger_machine(name)
    machine.b.data.fill_(-50.0)
    data = tensors([scene([0, 1, 2], [(0, 0, 1)]), scene([0, 1, 2], [(0, 2, 1)])], V)
    batch, target = data.batch(torch.arange(2)), torch.tensor([0, 0])
    left = switch_on_probability(machine, batch, target, True, rng())
    assert left[0] == 1
    assert left[1] < 1e-6
    deleted = switch_on_probability(machine, batch, target, False, rng())
    assert deleted.max() < 1e-6


@MACHINES
def test_deleted_relations_tell_nothing(name):
    """Two scenes that differ in the removed object's relations alone get the same answer."""
    machine = larger_machine(name)
    data = tensors([scene([0, 1, 2], [(0, 0, 1), (1, 1, 2)]), scene([0, 1, 2], [(1, 1, 2)])], V)
    p = [
        switch_on_probability(
            machine, data.batch(torch.tensor([k])), torch.tensor([0]), False, rng()
        )
        for k in (0, 1)
    ]
    assert torch.equal(*p)


@pytest.mark.parametrize("name", ["rbm", "gbm"])
def test_without_gates_the_object_follows_its_context(name):
    """One hidden draw: p(v_i = 1) as the energy has it, by flipping v_i."""
    machine = larger_machine(name).double()
    # No unit of a class with itself: of a single instance these stay unobserved.
    pairs = [(a, i, j) for a in range(4) for i in range(V) for j in range(V) if i != j]
    table = sorted(pairs[:: len(pairs) // machine.spec.T][: machine.spec.T])
    machine.set_triples(torch.tensor(table, dtype=torch.int32))
    data = tensors(random_scenes(8, V, seed=3), V)
    batch = data.batch(torch.arange(8))
    batch = replace(batch, v=batch.v.double())
    target = torch.tensor([int(entry.evidence.classes[0]) for entry in data.scenes])
    found = switch_on_probability(machine, batch, target, True, rng())
    edges, r, observed = relation_units(machine, batch)
    off = batch.v.scatter(1, target.unsqueeze(1), 0.0)
    on = batch.v.scatter(1, target.unsqueeze(1), 1.0)
    h1 = bernoulli(mean_field(machine, Evidence(off, edges, r, observed)).y.sigmoid(), rng())
    h2 = torch.zeros(8, machine.spec.H2, dtype=torch.float64)
    assert bool(observed.all())
    gap = machine.energy(off, r, h1, h2, edges) - machine.energy(on, r, h1, h2, edges)
    torch.testing.assert_close(found, gap.sigmoid())


def test_removed_objects_come_back_as_often_as_they_must():
    machine = larger_machine("rbm")
    for bias, share in ((80.0, 1.0), (-80.0, 0.0)):
        machine.b.data.fill_(bias)
        outcome = removed_switched_on(Model(machine=machine), SETTING)
        assert {metric.value for metric in outcome.metrics.values()} == {share}


def test_the_error_measure_counts_wrong_units():
    """All on: every absent class is wrong. Doing nothing: one class of V."""
    machine = larger_machine("rbm")
    machine.b.data.fill_(1e3)
    outcome = reconstruction_after_addition(Model(machine=machine), SETTING)
    asked = DATA.v[DATA.v.sum(1) >= 3]
    assert outcome.metrics["error measure"].value == pytest.approx(float(1 - asked.mean()))
    assert outcome.metrics["error measure, doing nothing"].value == pytest.approx(1 / V)
    assert outcome.metrics["added objects switched off"].value == 0
    assert outcome.metrics["objects of the scene kept on"].value == 1
