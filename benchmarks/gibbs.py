"""Benchmark of Gibbs sampling: sweeps per second of many chains of an RBM over objects."""

from __future__ import annotations

from collections.abc import Callable
from typing import Generic, TypeVar

import torch

from benchmarks.report import Result
from benchmarks.timing import interleave
from benchmarks.yardsticks import object_machine, presence, random_scenes, rbms, scikit_learn
from training.machines import MachineSpec
from training.machines.gibbs import gibbs_step, initial_state
from training.machines.machine import State

OURS, SKLEARN, RBMS = "ours", "scikit-learn", "rbms"
PRODUCTS = "two bare products"

S = TypeVar("S")


class Chains(Generic[S]):
    """Gibbs chains. Each call advances the state of all chains by one sweep."""

    def __init__(self, state: S, sweep: Callable[[S], S]) -> None:
        self.state, self.sweep = state, sweep

    def __call__(self) -> None:
        self.state = self.sweep(self.state)


@torch.no_grad()
def gibbs(
    *, V: int = 417, H: int = 200, chains: int = 512, objects: int = 12, rounds: int = 41
) -> Result:
    """Time one sweep over all chains, for our sampler and the samplers of other packages.

    All samplers use the same weights and the same initial scenes.

    Args:
        V: number of object classes.
        H: number of hidden units.
        chains: number of chains.
        objects: mean number of objects per scene.
        rounds: number of rounds; each round times every sampler.
    """
    machine = object_machine(MachineSpec("rbm", V=V, A=4, H1=H), objects)
    generator = torch.Generator().manual_seed(1)
    v = presence(random_scenes(chains, V, objects, generator), V)
    h = (torch.rand(chains, H, generator=generator) < 0.5).float()
    W = machine.W

    def sweep(state: State) -> State:
        # An RBM over objects has no relation units.
        return gibbs_step(machine, state, generator, relations=False)

    sklearn_rbm, rbms_rbm = scikit_learn(machine), rbms(machine)
    ours = Chains(initial_state(machine, v, generator), sweep)
    sklearn = Chains(v.numpy(), sklearn_rbm.gibbs)
    other = Chains(
        rbms_rbm.init_chains(chains, start_v=v),
        lambda state: rbms_rbm.sample_visibles(rbms_rbm.sample_hiddens(state)),
    )
    timings = interleave(
        {OURS: ours, SKLEARN: sklearn, RBMS: other, PRODUCTS: lambda: (v @ W, h @ W.T)},
        rounds=rounds,
    )
    return Result(
        name="gibbs",
        title=f"Gibbs sweeps of a {V} × {H} RBM, {chains} chains, one thread",
        subject=OURS,
        timings=timings,
        work=chains,
        unit="chain-sweeps/s",
        targets={SKLEARN: 2, RBMS: 2, PRODUCTS: 0.45},
        facts={
            "objects present a chain, ours": float(ours.state.v.sum(1).mean()),
            "objects present a chain, scikit-learn": float(sklearn.state.sum(1).mean()),
            "objects present a chain, rbms": float(other.state["visible"].sum(1).mean()),
        },
    )
