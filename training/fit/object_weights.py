"""Train the object weights of a machine by maximum likelihood with persistent Gibbs chains.

In the local form of the energy (`training.machines.machine`), the sum over relations is 1. The
gradient of log p(v) is therefore independent of relations:

    d log p(v) / dW = v' E[h1 | v] - E_model[v' h1]

The gradients of b, c1, c2, J and Q have the same form. Mean field gives the first expectation; it
is exact with one hidden layer. Gibbs chains give the second expectation. The chains continue from
one update to the next. The learning rate falls linearly to 0, so the weights change slowly at the
end, and the distribution of the chains stays close to the model. The weights are averaged over the
last part of the run.

The weights Q of room types are trained after all other weights, which then stay fixed. Q[t] follows
the gradient of log p(v | t), with a few chains for each room type t. In joint training, these few
chains would lag behind the changing weights.

Only scenes with a nearly complete object list are used. Scenes are drawn in proportion to their
weight. `fine_tune` is a shorter version. It runs after an objective that trains objects and
relations together.

Sources: Tieleman, "Training RBMs using approximations to the likelihood gradient" (2008);
Salakhutdinov and Hinton, "Deep Boltzmann machines" (2009), for two layers.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from training.datasets.batches import SceneTensors
from training.fit.configuration import FineTuneConfig, ObjectsConfig
from training.machines import BoltzmannMachine
from training.machines.bernoulli import bernoulli
from training.machines.chain_samples import pack_scenes
from training.machines.gibbs import Clamp, initial_state, run
from training.machines.machine import State
from training.machines.mean_field import Evidence, mean_field

OBJECT_WEIGHTS = ("b", "c1", "c2", "W", "J", "Q")
# The weights are averaged over this last share of the run. The newest weights have at least the
# share `_FORGETTING` in the moving average.
_AVERAGED = 0.3
_FORGETTING = 0.002
# Training of the room-type weights Q: number of chains and scenes of each room type in an update,
# number of updates, learning rate, and precision of the prior of Q, in units of scenes.
_PER_ROOM = 12
_ROOM_UPDATES = 1500
_ROOM_RATE = 0.2
_ROOM_PRIOR = 0.5
_SWEEPS = 200  # Gibbs sweeps between the last update and the storage of samples
_REPORTED = 100  # updates between two calls of `progress`
# Settings of `fine_tune`: names of the trained weights, decay of the moving average of the weights,
# and number of Gibbs sweeps before the storage of samples.
_FINE_TUNED = ("b", "c1", "c2", "W", "Q")
_FINE_TUNED_AVERAGING = 0.98
_FINE_TUNED_SWEEPS = 50


@dataclass
class _Chains:
    """Objects, (chains, classes), hidden units of both layers and room types of Gibbs chains."""

    v: Tensor
    h1: Tensor
    h2: Tensor
    room: Tensor


def fit_objects(
    machine: BoltzmannMachine,
    train: SceneTensors,
    config: ObjectsConfig,
    seed: int,
    progress: Callable[[float], None] = lambda _: None,
) -> None:
    """Train b, c1, c2, W, J and Q of a machine of the local form, in place; not with 0 epochs.

    Each update compares the next scenes, without room types, with the Gibbs chains. Scenes with
    incomplete object lists are left out.

    Raises:
        FloatingPointError: a weight became infinite or NaN.
    """
    if not config.epochs:
        return
    generator = torch.Generator().manual_seed(seed)
    scenes = _Scenes(train, generator)
    weights = {name: machine.get_parameter(name) for name in OBJECT_WEIGHTS if name != "Q"}
    updates = config.epochs * max(1, round(scenes.size / config.batch_size))
    with torch.no_grad():
        v, room = scenes.draw(config.chains)
        chains = _start_chains(machine, v, torch.full_like(room, -1))
        average = {name: weight.clone() for name, weight in weights.items()}
        for update in range(updates):
            v, _ = scenes.draw(config.batch_size)
            rate = config.learning_rate * (1 - update / updates)
            _update(machine, weights, v, chains, rate, generator)
            averaged = update - (1 - _AVERAGED) * updates  # updates in the average so far
            share = 1.0 if averaged <= 0 else max(_FORGETTING, 1 / (averaged + 1))
            for name, weight in weights.items():
                average[name].lerp_(weight, share)
            if (update + 1) % _REPORTED == 0 or update + 1 == updates:
                if not all(bool(weight.isfinite().all()) for weight in weights.values()):
                    raise FloatingPointError(
                        "the object weights diverged in training: lower objects.learning_rate"
                    )
                progress((update + 1) / updates)
        for name, weight in weights.items():
            weight.copy_(average[name])
        _fit_rooms(machine, scenes, generator)


def _fit_rooms(machine: BoltzmannMachine, scenes: _Scenes, generator: torch.Generator) -> None:
    """Train Q by maximum likelihood of p(v | t), separately for each room type t."""
    has_room = scenes.room >= 0
    counts = torch.zeros(len(machine.Q))
    counts.index_add_(0, scenes.room[has_room], scenes.weight[has_room])
    rooms = counts.nonzero().squeeze(1)
    if not len(rooms):
        return
    weights = torch.stack([scenes.weight * (scenes.room == t) for t in rooms.tolist()])
    chain_rooms = rooms.repeat_interleave(_PER_ROOM)

    def draw() -> Tensor:
        picks = torch.multinomial(weights, _PER_ROOM, replacement=True, generator=generator)
        return scenes.v[picks.flatten()]

    chains = _start_chains(machine, draw(), chain_rooms)
    decay = (_ROOM_PRIOR / counts[rooms]).unsqueeze(1)
    average = machine.Q.clone()
    for update in range(_ROOM_UPDATES):
        rate = _ROOM_RATE * (1 - update / _ROOM_UPDATES)
        data = mean_field(machine, Evidence(draw(), room=chain_rooms)).y.sigmoid()
        step = (data - _sweep(machine, chains, generator)).unflatten(0, (len(rooms), -1)).mean(1)
        machine.Q[rooms] += rate * (step - decay * machine.Q[rooms])
        averaged = update - (1 - _AVERAGED) * _ROOM_UPDATES
        average.lerp_(machine.Q, 1.0 if averaged <= 0 else 1 / (averaged + 1))
    machine.Q.copy_(average)


@torch.no_grad()
def store_samples(
    machine: BoltzmannMachine, train: SceneTensors, room_dropout: float, seed: int
) -> None:
    """Store samples in the machine: the final states of N long Gibbs chains.

    Each chain starts at a training scene, and its sample has the room type of that scene. A share
    of the chains, `room_dropout`, runs without a room type.
    """
    if not machine.spec.N:
        return
    generator = torch.Generator().manual_seed(seed + 1)
    scenes = _Scenes(train, generator)
    v, room = scenes.draw(machine.spec.N)
    hidden = torch.rand(len(v), generator=generator) < room_dropout
    chains = _start_chains(machine, v, torch.where(hidden, -1, room))
    for _ in range(_SWEEPS):
        _sweep(machine, chains, generator)
    machine.fantasies.copy_(pack_scenes(chains.v))
    machine.fantasy_rooms.copy_(room)


class _Scenes:
    """Scenes with complete object lists, drawn by weight. `size` is the sum of all weights."""

    def __init__(self, train: SceneTensors, generator: torch.Generator):
        kept = train.complete.nonzero().squeeze(1)
        if not len(kept):
            raise ValueError(
                "no training scene has a complete object list; add such scenes, or set "
                "objects.epochs to 0"
            )
        self.v, self.room, self.weight = train.v[kept], train.room[kept], train.weight[kept]
        self.size = float(self.weight.sum())
        self._generator = generator
        self._order = torch.zeros(0, dtype=torch.int64)

    def draw(self, count: int) -> tuple[Tensor, Tensor]:
        """Return the objects, (scenes, classes), and room types, (scenes,), of the next scenes."""
        while len(self._order) < count:
            self._order = torch.cat([self._order, self._shuffled()])
        index, self._order = self._order[:count], self._order[count:]
        return self.v[index], self.room[index]

    def _shuffled(self) -> Tensor:
        """Start a random pass; the expected number of draws of a scene is its weight."""
        times = self.weight.floor()
        extra = torch.rand(len(times), generator=self._generator) < self.weight - times
        index = torch.arange(len(times)).repeat_interleave(times.long() + extra)
        if not len(index):
            index = self.weight.argmax().view(1)
        return index[torch.randperm(len(index), generator=self._generator)]


def _start_chains(machine: BoltzmannMachine, v: Tensor, room: Tensor) -> _Chains:
    field = mean_field(machine, Evidence(v, room=room))
    return _Chains(v.clone(), field.y.sigmoid().round(), field.h2.round(), room)


def _update(
    machine: BoltzmannMachine,
    weights: Mapping[str, Tensor],
    v: Tensor,
    chains: _Chains,
    rate: float,
    generator: torch.Generator,
) -> None:
    """Add the gradient at the scenes v, and subtract the gradient at the advanced chains."""
    field = mean_field(machine, Evidence(v, room=torch.full((len(v),), -1)))
    _accumulate(weights, v, field.y.sigmoid(), field.h2, rate / len(v))
    mean = _sweep(machine, chains, generator)
    _accumulate(weights, chains.v, mean, chains.h2, -rate / len(chains.v))


def _sweep(machine: BoltzmannMachine, chains: _Chains, generator: torch.Generator) -> Tensor:
    """Run one Gibbs sweep; return the probabilities that h1 was sampled from, (chains, H1)."""
    chains.v = bernoulli(machine.object_logits(chains.h1).sigmoid(), generator)
    if machine.spec.H2:
        h2 = machine.second_layer_logits(chains.h1).sigmoid()
        chains.h2 = bernoulli(h2, generator)
    x = machine.context_bias(chains.room) + chains.v @ machine.W
    if machine.spec.H2:
        x = x + chains.h2 @ machine.J.T
    mean = x.sigmoid()
    chains.h1 = bernoulli(mean, generator)
    return mean


def _accumulate(
    weights: Mapping[str, Tensor], v: Tensor, h1: Tensor, h2: Tensor, rate: float
) -> None:
    """Add the gradient of -E to the weights, summed over scenes and multiplied by the rate."""
    weights["b"].add_(v.sum(0), alpha=rate)
    weights["c1"].add_(h1.sum(0), alpha=rate)
    weights["W"].addmm_(v.T, h1, alpha=rate)
    if h2.shape[1]:
        weights["c2"].add_(h2.sum(0), alpha=rate)
        weights["J"].addmm_(h1.T, h2, alpha=rate)


def fine_tune(
    machine: BoltzmannMachine,
    train: SceneTensors,
    config: FineTuneConfig,
    room_dropout: float,
    seed: int,
) -> None:
    """Fine-tune a machine of the local form until its samples match the data, in place.

    After training by conditional likelihoods, conditionals are accurate but samples are biased:
    sampled scenes contain 50 % too many objects. Persistent contrastive divergence with many chains
    removes the bias. It changes only b, c1, c2, W and Q. The penalty anchor · sum (θ - θ_before)²
    keeps the conditionals accurate. The function then stores N samples. They come from chains with
    the averaged weights, and each sample has the room type of the scene where its chain started.
    A share of the chains and scenes, `room_dropout`, has no room type.
    """
    if not config.updates and not machine.spec.N:
        return
    generator = torch.Generator().manual_seed(seed)

    def scenes(count: int) -> tuple[Tensor, Tensor, Tensor]:
        index = torch.randint(len(train), (count,), generator=generator)
        hidden = torch.rand(count, generator=generator) < room_dropout
        rooms = train.room[index]
        return train.v[index], torch.where(hidden, -1, rooms), rooms

    v, room, all_rooms = scenes(max(config.chains, machine.spec.N))
    state = _start_state(machine, v, room, generator)
    initial = {name: machine.get_parameter(name).detach().clone() for name in _FINE_TUNED}
    average = {name: value.clone() for name, value in initial.items()}
    weights = [machine.get_parameter(name) for name in _FINE_TUNED]
    optimiser = torch.optim.Adam(weights, lr=config.learning_rate)
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimiser, max(config.updates, 1))
    for _ in range(config.updates):
        state = run(machine, state, generator, config.k, Clamp(room=room), relations=False)
        data_v, data_room, _ = scenes(len(v))
        with torch.no_grad():
            field = mean_field(machine, Evidence(data_v, room=data_room))
            h2 = bernoulli(field.h2, generator)
        loss = machine.free_energy(data_v, h2=h2, room=data_room).mean()
        loss = loss - machine.free_energy(state.v, h2=state.h2, room=room).mean()
        for name, weight in zip(_FINE_TUNED, weights, strict=True):
            loss = loss + config.anchor * ((weight - initial[name]) ** 2).sum()
        optimiser.zero_grad()
        loss.backward()
        optimiser.step()
        schedule.step()
        for name, weight in zip(_FINE_TUNED, weights, strict=True):
            average[name].lerp_(weight.detach(), 1 - _FINE_TUNED_AVERAGING)
    with torch.no_grad():
        for name, weight in zip(_FINE_TUNED, weights, strict=True):
            weight.copy_(average[name])
    if machine.spec.N:
        clamp = Clamp(room=all_rooms)
        state = run(machine, state, generator, _FINE_TUNED_SWEEPS, clamp, relations=False)
        machine.fantasies.copy_(pack_scenes(state.v[: machine.spec.N]))
        machine.fantasy_rooms.copy_(all_rooms[: machine.spec.N])


@torch.no_grad()
def _start_state(
    machine: BoltzmannMachine, v: Tensor, room: Tensor, generator: torch.Generator
) -> State:
    """Return chains that start at the scenes v, with hidden units sampled given v."""
    field = mean_field(machine, Evidence(v, room=room))
    return replace(
        initial_state(machine, v, generator, Clamp(room=room)),
        h1=bernoulli(field.y.sigmoid(), generator),
        h2=bernoulli(field.h2, generator),
    )
