"""Base rates of whole scenes, and the test that long chains stay like the scenes."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from tests.training.fit.test_objects import SPECS, V, log_p, machine_of, scenes_of
from training.fit import long_chains
from training.fit.configuration import ObjectsConfig
from training.fit.long_chains import LongChains, measure_drift, populations, scene_chains
from training.fit.samples import fit_scene_rates
from training.machines.arrays import weights_of

SHOWS = torch.tensor([[True] * V, [True, True, True, False]])
CONFIG = ObjectsConfig(served_sources={"sunrgbd": 2.0, "procthor": 1.0})
LABELS = ("bed", "lamp", "desk", "chair")


def fitted(name):
    machine, scenes = machine_of(name, scale=0.6), scenes_of(SHOWS)
    with torch.no_grad():
        machine.u.zero_()
        if machine.spec.coupled:
            machine.L.copy_(machine.couplings)
        fit_scene_rates(machine, scenes, CONFIG, seed=0)
    return machine.requires_grad_(False), scenes


def exact_shares(machine, scenes, population):
    """p(v_i = 1) in chains that keep the room types of the scenes, (V,), by enumeration."""
    every = (torch.arange(2**V).unsqueeze(1) >> torch.arange(V) & 1).double()
    source = -1 if population.profile is None else population.profile
    total = torch.zeros(V).double()
    for room in scenes.room.unique().tolist():
        weight = float(population.weight[(scenes.room == room).numpy()].sum())
        total += weight * (log_p(machine, room, source).double().exp() @ every)
    return total.numpy()


@pytest.mark.parametrize("name", SPECS)
def test_long_chains_have_the_shares_of_the_scenes(name):
    """Of each source and of the served mix, without classes that the source cannot show."""
    machine, scenes = fitted(name)
    for population in populations(scenes, CONFIG):
        exact = exact_shares(machine, scenes, population)[population.shows]
        np.testing.assert_allclose(exact, population.p[population.shows], atol=0.02)
    assert not machine.u[1, 3]


def test_a_population_weighs_scenes_by_source():
    """The served mix counts sources by their served weights, whatever their numbers of scenes."""
    scenes = scenes_of(SHOWS)
    *by_source, mixed = populations(scenes, CONFIG)
    expected = (2 * by_source[0].p + by_source[1].p) / 3
    np.testing.assert_allclose(mixed.p, expected)
    for q, population in enumerate(by_source):
        own = scenes.v[scenes.source == q].double().mean(0)
        np.testing.assert_allclose(population.p, own)


def test_served_sources_without_scenes_leave_a_mix_of_all():
    elsewhere = ObjectsConfig(served_sources={"3dssg": 1.0})
    *_, mixed = populations(scenes_of(SHOWS), elsewhere)
    *_, equal = populations(scenes_of(SHOWS), ObjectsConfig())
    np.testing.assert_array_equal(mixed.p, equal.p)


def test_chains_start_at_each_room_type_in_proportion():
    scenes = scenes_of(SHOWS)
    mixed = list(populations(scenes, CONFIG))[-1]
    rooms = mixed.room[mixed.draw(300, np.random.default_rng(0))]
    for room in (-1, 0, 1):
        assert abs((rooms == room).sum() - 300 * mixed.weight[mixed.room == room].sum()) <= 1


def test_chains_continue_from_call_to_call():
    """The states after two calls are those after one call, and each chain counts by itself."""
    machine, scenes = machine_of("coupled", scale=0.6), scenes_of(SHOWS)
    population = next(populations(scenes, CONFIG))
    chains = scene_chains(weights_of(machine))
    once, twice = (LongChains(chains, scenes, population, 6, seed=3) for _ in range(2))
    share = once.run(20)
    halves = twice.run(10), twice.run(10)
    np.testing.assert_array_equal(once.on, twice.on)
    np.testing.assert_allclose(share, (halves[0] + halves[1]) / 2)
    assert share.shape == (6, V)


def test_only_a_drift_beyond_its_limit_is_an_objection(monkeypatch):
    monkeypatch.setattr(long_chains, "_CHAINS", 64)
    machine, scenes = fitted("coupled")
    drifts = measure_drift(weights_of(machine), LABELS, scenes, CONFIG)
    assert [drift.source for drift in drifts] == ["sunrgbd", "procthor"]
    assert [drift.objection() for drift in drifts] == [None, None]
    machine.u[0] -= 3.0
    drift, other = measure_drift(weights_of(machine), LABELS, scenes, CONFIG)
    assert drift.size < -0.5
    assert "after 3000 sweeps, generated scenes of sunrgbd have -" in drift.objection()
    assert other.objection() is None
    machine.u[0] = torch.tensor([9.0, -9.0, 0.0, 0.0])
    drift, _ = measure_drift(weights_of(machine), LABELS, scenes, CONFIG)
    assert drift.label == "lamp"
    assert drift.share == pytest.approx(-1, abs=0.01)
    metrics = {metric.metric: metric for metric in drift.metrics()}
    assert metrics["largest change of a class"].value == pytest.approx(drift.share, abs=1e-4)
