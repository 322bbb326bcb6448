"""The last phase: chains come to the data, answers stay, and fantasies follow the machine's law."""

from __future__ import annotations

import math

import pytest
import torch

from tests.training.evaluation.scenes import WIDE, random_scenes, scene, tensors
from tests.training.test_trainer import small_config
from training.config import PolishConfig, with_settings
from training.machines import MachineSpec, build
from training.machines.chain_samples import unpack_scenes
from training.objects import fine_tune as polish
from training.pipeline import prepare
from training.trainer import Trainer

DATA = tensors(random_scenes(20), WIDE)


def machine_of(N, variant="triway", form="local", scale=0.5):
    K = 2 if variant == "triway" else 0
    machine = build(MachineSpec(variant, V=WIDE, A=4, H1=5, K=K, N=N, form=form))
    generator = torch.Generator().manual_seed(3)
    with torch.no_grad():
        machine.W.copy_(torch.randn(machine.W.shape, generator=generator) * scale)
        machine.b.copy_(torch.linspace(-3, 1, WIDE))
    return machine.requires_grad_(False)


def dream(machine, scenes, seed):
    polish(machine, scenes, PolishConfig(updates=0, chains=1), 0.5, seed)


def dreamt(machine):
    return unpack_scenes(machine.fantasies, machine.spec.V)


def test_fantasies_follow_the_machine_and_not_the_scenes_they_began_at():
    """Independent classes: frequencies within five standard errors, 12 classes, so that chance
    fails with probability < 8e-6."""
    machine = machine_of(3000, scale=0.0)
    dream(machine, DATA, 0)
    found = dreamt(machine).double().mean(0)
    for p, share in zip(machine.b.double().sigmoid().tolist(), found.tolist(), strict=True):
        assert abs(share - p) <= 5 * math.sqrt(p * (1 - p) / 3000)


def test_each_fantasy_knows_the_room_type_it_was_dreamt_under():
    rooms = [k % 3 - 1 for k in range(30)]
    data = tensors([scene([0, 1], room=room) for room in rooms], WIDE)
    spec = MachineSpec("rbm", V=WIDE, A=4, H1=2, C=2, N=300, form="local")
    machine = build(spec).requires_grad_(False)
    machine.b.fill_(-4.0)
    machine.W[2:4, 0], machine.W[4:6, 1] = 8.0, 8.0
    machine.c1.fill_(-12.0)
    machine.Q[:] = torch.eye(2) * 20
    dream(machine, data, 0)
    found, own = dreamt(machine), machine.fantasy_rooms
    assert set(own.tolist()) == {-1, 0, 1}
    for room, things in ((0, slice(2, 4)), (1, slice(4, 6))):
        # h1 is on with probability 0.9997 there, and each thing then with 0.98.
        assert float(found[own == room][:, things].mean()) > 0.85
        assert float(found[own != room][:, things].mean()) < 0.15


@pytest.mark.parametrize("variant", ["triway", "gbm"])
def test_chains_come_to_the_data(variant):
    """Scenes of two kinds; a machine that is far too full. The frequencies of its own scenes are
    at most half as far from the data's after the updates, and the anchor holds the weights back."""
    v = torch.zeros(40, WIDE)
    v[:20, :4], v[20:, 6:10] = 1, 1
    data = tensors([scene(row.nonzero().squeeze(1).tolist()) for row in v], WIDE)

    def distance(machine):
        return float((dreamt(machine).mean(0) - v.mean(0)).abs().sum())

    def polished(**changes):
        machine = machine_of(400, variant)
        machine.b.fill_(1.0)
        machine.requires_grad_()
        start = machine.W.detach().clone()
        polish(machine, data, PolishConfig(learning_rate=0.05, **changes), 0.5, 1)
        return machine, float((machine.W.detach() - start).abs().mean())

    (before, none), (after, much), (held, little) = (
        polished(updates=0),
        polished(updates=400, anchor=0.0),
        polished(updates=400, anchor=10.0),
    )
    assert none == 0
    assert distance(after) < 0.5 * distance(before)
    assert 0 < little < 0.2 * much
    assert distance(held) < distance(before)


def test_a_trained_machine_is_polished(tmp_path):
    """Once, from its best weights: a finished run that is resumed ends at the same weights."""
    changes = {"machine.N": 30, "data.rooms": 60, "polish.updates": 5}
    config = with_settings(small_config(epochs=1), changes)
    data = prepare(config, tmp_path).training_data()
    first = Trainer(config, data, tmp_path).run().machine
    again = Trainer(config, data, tmp_path)
    assert again.resume()
    second = again.run().machine
    assert len(dreamt(first).unique(dim=0)) > 5
    for name, value in first.state_dict().items():
        assert torch.equal(value, second.state_dict()[name]), name
    plain = with_settings(config, {"polish.updates": 0})
    assert not torch.equal(Trainer(plain, data).run().machine.W, first.W)
