"""Benchmark of Gibbs sampling: sweeps per second of many chains of an RBM over objects."""

from __future__ import annotations

import torch

from benchmarks.report import Result
from benchmarks.timing import interleave
from benchmarks.yardsticks import object_machine, presence, random_scenes, rbms, scikit_learn
from training.machines import MachineSpec
from training.machines.gibbs import Chains, sweep

OURS, SKLEARN, RBMS = "ours", "scikit-learn", "rbms"
PRODUCTS = "two bare products"


@torch.no_grad()
def gibbs(
    *, V: int = 417, H: int = 200, chains: int = 512, objects: int = 12, rounds: int = 41
) -> Result:
    """Time one sweep over all chains, for our sampler and the samplers of other packages.

    All samplers use the same weights and the same initial scenes, with `objects` classes each. The
    machine has V classes and H hidden units. Each of the rounds times every sampler.
    """
    machine = object_machine(MachineSpec("rbm", V=V, A=4, units=H), objects)
    generator = torch.Generator().manual_seed(1)
    v = presence(random_scenes(chains, V, objects, generator), V)
    h = (torch.rand(chains, H, generator=generator) < 0.5).float()
    W = machine.W
    sklearn_rbm, rbms_rbm = scikit_learn(machine), rbms(machine)
    none = torch.full((chains,), -1)
    ours = Chains(v, none, none, torch.ones(v.shape, dtype=torch.bool))
    sklearn, other = v.numpy(), rbms_rbm.init_chains(chains, start_v=v)

    def sklearn_sweep() -> None:
        nonlocal sklearn
        sklearn = sklearn_rbm.gibbs(sklearn)

    def rbms_sweep() -> None:
        nonlocal other
        other = rbms_rbm.sample_visibles(rbms_rbm.sample_hiddens(other))

    timings = interleave(
        {
            OURS: lambda: sweep(machine, ours, generator),
            SKLEARN: sklearn_sweep,
            RBMS: rbms_sweep,
            PRODUCTS: lambda: (v @ W, h @ W.T),
        },
        rounds=rounds,
    )
    return Result(
        title=f"Gibbs sweeps of a {V} × {H} RBM, {chains} chains, one thread",
        subject=OURS,
        timings=timings,
        work=chains,
        unit="chain-sweeps/s",
        targets={SKLEARN: 2, RBMS: 2, PRODUCTS: 0.45},
        facts={
            "objects present a chain, ours": float(ours.v.sum(1).mean()),
            "objects present a chain, scikit-learn": float(sklearn.sum(1).mean()),
            "objects present a chain, rbms": float(other["visible"].sum(1).mean()),
        },
    )
