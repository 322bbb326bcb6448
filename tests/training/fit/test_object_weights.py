"""The object part: likelihood, room types and samples by enumeration; the fine tuning."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
import torch

from tests.enumeration.small_machines import binary
from tests.training.evaluation.scenes import WIDE, random_scenes, scene, tensors
from tests.training.fit.test_trainer import same, small_config, weights
from training.fit import object_weights as objects
from training.fit.configuration import FineTuneConfig, ObjectsConfig
from training.fit.object_weights import OBJECT_WEIGHTS, fine_tune, fit_objects, store_samples
from training.fit.trainer import Trainer
from training.machines import MachineSpec, build
from training.machines.chain_samples import unpack_scenes
from training.runs.config_files import with_settings
from training.runs.pipeline import prepare

V = 4
EVERY = binary(V).float()
CONFIG = ObjectsConfig(epochs=40, learning_rate=0.3, chains=200, batch_size=50)


def machine_of(H2=0, C=0, N=0, scale=0.05, seed=0, form="local"):
    variant = "triway" if form == "seed" or not H2 else "gbm"
    K = 2 if variant == "triway" else 0
    machine = build(MachineSpec(variant, V=V, A=2, H1=3, H2=H2, C=C, K=K, N=N, form=form))
    generator = torch.Generator().manual_seed(seed)
    with torch.no_grad():
        for name in OBJECT_WEIGHTS:
            weight = machine.get_parameter(name)
            weight.copy_(torch.randn(weight.shape, generator=generator) * scale)
    return machine


def log_p(machine, room=-1):
    """log p(v | room) of every v, (2^V,), by enumeration of both hidden layers."""
    H1, H2 = machine.spec.H1, machine.spec.H2
    v, h1, h2 = EVERY.double(), binary(H1), binary(H2) if H2 else torch.zeros(1, 0).double()
    b, c2, W, J = (machine.get_parameter(n).double() for n in ("b", "c2", "W", "J"))
    c1 = machine.context_bias(torch.tensor([room])).double()[0]
    joint = (v @ b).view(-1, 1, 1) + (v @ W @ h1.T).unsqueeze(2)
    joint = joint + (h1 @ c1).view(1, -1, 1) + (h1 @ J @ h2.T) + h2 @ c2
    return joint.logsumexp((1, 2)).log_softmax(0)


def context(likely):
    """Independent classes with these probabilities, (2^V,)."""
    p = torch.tensor(likely).double()
    return torch.where(EVERY > 0, p, 1 - p).prod(1)


ONE, TWO = context((0.9, 0.9, 0.1, 0.15)), context((0.1, 0.1, 0.9, 0.85))
TARGET = 0.6 * ONE + 0.4 * TWO
"""Two contexts, which a machine with one context unit has."""


def drawn(p, total=1000, **options):
    """Every set of classes once, weighted by its probability: data without sampling noise."""
    return [
        replace(scene(row.nonzero().squeeze(1).tolist(), **options), weight=float(weight) * total)
        for row, weight in zip(EVERY, p, strict=True)
    ]


def divergence(p, machine, room=-1):
    """KL(p | machine) in nats."""
    return float((p * (p.log() - log_p(machine, room))).sum().detach())


def independent(p):
    """KL of p against independent classes of the same frequencies."""
    share = (p @ EVERY.double()).clamp(1e-6, 1 - 1e-6)
    log_q = (EVERY.double() * share.log() + (1 - EVERY.double()) * (1 - share).log()).sum(1)
    return float((p * (p.log() - log_q)).sum())


def test_an_update_is_the_likelihood_s_gradient():
    """Chains drawn from the machine itself: each entry is the mean of 200,000 products within
    [-1, 1], so six standard errors are below .0135 (missed by chance with p < 1e-7)."""
    machine = machine_of(scale=1.0)
    loss = -(TARGET * log_p(machine)).sum()
    loss.backward()
    count = 200_000
    generator = torch.Generator().manual_seed(1)
    with torch.no_grad():
        room = torch.full((count,), -1)
        v = EVERY[torch.multinomial(log_p(machine).exp(), count, True, generator=generator)]
        h1 = torch.rand(count, 3, generator=generator) < (machine.c1 + v @ machine.W).sigmoid()
        chains = objects._Chains(v, h1.float(), torch.zeros(count, 0), room)
        data = EVERY.repeat_interleave((TARGET * count).round().long(), dim=0)
        step = {name: torch.zeros_like(machine.get_parameter(name)) for name in ("b", "c1", "W")}
        objects._update(machine, step, data, chains, 1.0, generator)
    for name, found in step.items():
        torch.testing.assert_close(found, -machine.get_parameter(name).grad, atol=0.0135, rtol=0)


@pytest.mark.parametrize("H2", [0, 2])
def test_training_brings_the_enumerated_divergence_down(H2):
    """Far below that of independent classes, with which it starts."""
    machine = machine_of(H2)
    begun, alone = divergence(TARGET, machine), independent(TARGET)
    assert alone > 0.2
    fit_objects(machine, tensors(drawn(TARGET), V), CONFIG, seed=0)
    reached = divergence(TARGET, machine)
    assert reached < 0.15 * alone
    assert reached < 0.1 * begun


def test_scenes_count_by_their_weight_and_incomplete_ones_not_at_all():
    data = drawn(TARGET)
    others = [replace(one, weight=0.0) for one in drawn(ONE)]
    machine = machine_of()
    fit_objects(machine, tensors(data + others, V), CONFIG, seed=0)
    assert divergence(TARGET, machine) < 0.15 * independent(TARGET)
    incomplete = [replace(one, complete=False) for one in drawn(ONE)]
    first, second = machine_of(), machine_of()
    fit_objects(first, tensors(data, V), CONFIG, seed=0)
    fit_objects(second, tensors(incomplete[:8] + data + incomplete[8:], V), CONFIG, seed=0)
    assert same(weights(first), weights(second))


def rooms():
    """A room type for each context, and scenes of an unknown one."""
    return tensors([*drawn(ONE, 500, room=0), *drawn(TWO, 300, room=1), *drawn(TARGET, 200)], V)


def test_room_types_improve_the_conditional_likelihood_alone():
    """Q is trained with all other weights as they are, so p(v) without a room type stays."""
    data = rooms()
    machine, without = machine_of(C=3), machine_of(C=3)
    fit_objects(machine, data, CONFIG, seed=0)
    fit_objects(without, replace(data, room=torch.full_like(data.room, -1)), CONFIG, seed=0)
    for name in OBJECT_WEIGHTS[:-1]:
        assert torch.equal(machine.get_parameter(name), without.get_parameter(name))
    assert torch.equal(log_p(machine), log_p(without))
    for room, own in ((0, ONE), (1, TWO)):
        assert divergence(own, machine, room) < divergence(own, machine) - 0.1
    # No scene is of the third type.
    assert torch.equal(machine.Q[2], without.Q[2])


def test_without_a_complete_scene_there_is_nothing_to_learn_from():
    data = tensors([replace(one, complete=False) for one in drawn(TARGET)], V)
    with pytest.raises(ValueError, match="complete object list"):
        fit_objects(machine_of(), data, CONFIG, seed=0)


@torch.no_grad()
def test_samples_follow_the_machine():
    """4,000 chains: each share of 16 within five standard errors, so that chance fails with
    probability below 1e-5."""
    machine = machine_of(C=2, N=4000, scale=1.0)
    data = rooms()
    store_samples(machine, data, room_dropout=1.0, seed=0)
    sets = unpack_scenes(machine.fantasies, V) @ torch.tensor([1.0, 2.0, 4.0, 8.0])
    share = torch.bincount(sets.long(), minlength=16).double() / 4000
    p = log_p(machine).exp().detach()
    for found, wanted in zip(share.tolist(), p.tolist(), strict=True):
        assert abs(found - wanted) <= 5 * math.sqrt(wanted * (1 - wanted) / 4000)


@torch.no_grad()
def test_samples_keep_the_room_type_they_were_drawn_under():
    machine = machine_of(C=2, N=3000, scale=1.0)
    with torch.no_grad():
        machine.Q[0], machine.Q[1] = -4.0, 4.0
    data = rooms()
    store_samples(machine, data, room_dropout=0.0, seed=0)
    own_room, found = machine.fantasy_rooms.long(), unpack_scenes(machine.fantasies, V)
    assert set(own_room.tolist()) == {-1, 0, 1}
    for room in (-1, 0, 1):
        own = found[own_room == room].double()
        p = log_p(machine, room).exp() @ EVERY.double()
        error = 5 * (p * (1 - p) / len(own)).sqrt()
        assert bool(((own.mean(0) - p).abs() <= error).all())


# -- fine tuning ----------------------------------------------------------------------------------

DATA = tensors(random_scenes(20), WIDE)


def wide_machine(N, variant="triway", form="local", scale=0.5):
    K = 2 if variant == "triway" else 0
    machine = build(MachineSpec(variant, V=WIDE, A=4, H1=5, K=K, N=N, form=form))
    generator = torch.Generator().manual_seed(3)
    with torch.no_grad():
        machine.W.copy_(torch.randn(machine.W.shape, generator=generator) * scale)
        machine.b.copy_(torch.linspace(-3, 1, WIDE))
    return machine.requires_grad_(False)


def store(machine, scenes, seed):
    fine_tune(machine, scenes, FineTuneConfig(updates=0, chains=1), 0.5, seed)


def stored(machine):
    return unpack_scenes(machine.fantasies, machine.spec.V)


def test_fine_tuned_samples_follow_the_machine():
    """Independent classes: frequencies within five standard errors, 12 classes, so that chance
    fails with probability < 8e-6."""
    machine = wide_machine(3000, scale=0.0)
    store(machine, DATA, 0)
    found = stored(machine).double().mean(0)
    for p, share in zip(machine.b.double().sigmoid().tolist(), found.tolist(), strict=True):
        assert abs(share - p) <= 5 * math.sqrt(p * (1 - p) / 3000)


def test_each_sample_keeps_the_room_type_of_its_chain():
    rooms = [k % 3 - 1 for k in range(30)]
    data = tensors([scene([0, 1], room=room) for room in rooms], WIDE)
    spec = MachineSpec("rbm", V=WIDE, A=4, H1=2, C=2, N=300, form="local")
    machine = build(spec).requires_grad_(False)
    machine.b.fill_(-4.0)
    machine.W[2:4, 0], machine.W[4:6, 1] = 8.0, 8.0
    machine.c1.fill_(-12.0)
    machine.Q[:] = torch.eye(2) * 20
    store(machine, data, 0)
    found, own = stored(machine), machine.fantasy_rooms
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
        return float((stored(machine).mean(0) - v.mean(0)).abs().sum())

    def fine_tuned(**changes):
        machine = wide_machine(400, variant)
        machine.b.fill_(1.0)
        machine.requires_grad_()
        start = machine.W.detach().clone()
        fine_tune(machine, data, FineTuneConfig(learning_rate=0.05, **changes), 0.5, 1)
        return machine, float((machine.W.detach() - start).abs().mean())

    before, none = fine_tuned(updates=0)
    after, much = fine_tuned(updates=400, anchor=0.0)
    held, little = fine_tuned(updates=400, anchor=10.0)
    assert none == 0
    assert distance(after) < 0.5 * distance(before)
    assert 0 < little < 0.2 * much
    assert distance(held) < distance(before)


def test_a_trained_machine_is_fine_tuned(tmp_path):
    """Once, from its best weights: a finished run that is resumed ends at the same weights."""
    changes = {"machine.N": 30, "data.rooms": 60, "polish.updates": 5}
    config = with_settings(small_config(epochs=1), changes)
    data = prepare(config, tmp_path).training_data()
    first = Trainer(config, data, tmp_path).run().machine
    again = Trainer(config, data, tmp_path)
    assert again.resume()
    second = again.run().machine
    assert len(stored(first).unique(dim=0)) > 5
    for name, value in first.state_dict().items():
        assert torch.equal(value, second.state_dict()[name]), name
    plain = with_settings(config, {"polish.updates": 0})
    assert not torch.equal(Trainer(plain, data).run().machine.W, first.W)
