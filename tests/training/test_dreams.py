"""The fantasies of a trained machine: filled, the same for a seed, and drawn from its own law."""

from __future__ import annotations

import math

import pytest
import torch

from app.boltzmann import MachineSpec, build
from app.boltzmann.fantasies import unpack_scenes
from tests.training.evaluation.scenes import WIDE, random_scenes, tensors
from tests.training.test_trainer import small_config
from training.config import with_settings
from training.dreams import dream
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


def dreamt(machine):
    return unpack_scenes(machine.fantasies, machine.spec.V)


@pytest.mark.parametrize("variant", ["triway", "rbm"])
def test_a_seed_dreams_the_same_scenes(variant):
    first, again, other = (machine_of(50, variant) for _ in range(3))
    assert not bool(first.fantasies.any())
    for machine, seed in ((first, 1), (again, 1), (other, 2)):
        dream(machine, DATA, seed)
    assert torch.equal(first.fantasies, again.fantasies)
    assert not torch.equal(first.fantasies, other.fantasies)
    assert len(dreamt(first).unique(dim=0)) > 5


def test_fantasies_follow_the_machine_and_not_the_scenes_they_began_at():
    """Independent classes: frequencies within five standard errors, 12 classes, so that chance
    fails with probability < 8e-6."""
    machine = machine_of(3000, scale=0.0)
    dream(machine, DATA, 0)
    found = dreamt(machine).double().mean(0)
    for p, share in zip(machine.b.double().sigmoid().tolist(), found.tolist(), strict=True):
        assert abs(share - p) <= 5 * math.sqrt(p * (1 - p) / 3000)


def test_without_fantasies_nothing_is_dreamt():
    machine = machine_of(0)
    dream(machine, DATA, 0)
    assert not hasattr(machine, "fantasies")


def test_the_seed_form_is_refused():
    with pytest.raises(ValueError, match="local form"):
        dream(machine_of(4, form="seed"), DATA, 0)


def test_a_trained_machine_has_dreamt(tmp_path):
    """Its fantasies are those of its best weights."""
    config = with_settings(small_config(epochs=1), {"machine.N": 30, "data.rooms": 60})
    data = prepare(config, tmp_path).training_data()
    machine = Trainer(config, data).run().machine
    kept = machine.fantasies.clone()
    assert len(kept.unique(dim=0)) > 5
    dream(machine, data.train, config.training.seed)
    assert torch.equal(machine.fantasies, kept)
