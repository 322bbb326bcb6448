"""Benchmark of missing objects: time to compute the log-odds of all classes for one scene."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from torch import Tensor

from app.inference.objects import ContextScorer
from benchmarks.report import Result
from benchmarks.timing import interleave
from benchmarks.yardsticks import object_machine, presence, random_scenes, scikit_learn
from training.machines import MachineSpec
from training.machines.log_odds import object_log_odds
from training.machines.mean_field import Evidence, mean_field

OURS, UNPREPARED = "ours, exp(W) precomputed", "ours, from the weights alone"
TWO_COPIES = "scikit-learn, 2 V copies"
ONE_COPY = "scikit-learn, V + 1 copies"


@torch.inference_mode()
def log_odds(
    *, V: int = 417, H: int = 200, objects: int = 12, K: int = 32, rounds: int = 31
) -> Result:
    """Time the closed form of the Triway machine, and scikit-learn with one scene copy per class.

    In the local form of the Triway machine, unobserved relations have no effect on objects. Its
    log-odds therefore equal those of a plain RBM such as scikit-learn's.

    Args:
        V: number of object classes.
        H: number of hidden units.
        objects: number of objects in the scene.
        K: rank of the relation weights.
        rounds: number of rounds; each round times every method.
    """
    spec = MachineSpec("triway", V=V, A=4, H1=H, K=K, form="local")
    machine = object_machine(spec, objects)
    scorer, rbm = ContextScorer(machine.W.detach().numpy()), scikit_learn(machine)
    v = presence(random_scenes(1, V, objects, torch.Generator().manual_seed(1)), V)

    def prepared() -> Tensor:
        y = mean_field(machine, Evidence(v)).y[0].numpy()
        return machine.b + torch.from_numpy(scorer.gain(y))

    def unprepared() -> Tensor:
        return object_log_odds(machine, Evidence(v))

    def two_copies() -> Any:
        """For each class, compare the scene with the class and the scene without the class.

        The result is valid for all classes.
        """
        present = np.repeat(v.numpy(), V, axis=0)
        absent = present.copy()
        np.fill_diagonal(present, 1)
        np.fill_diagonal(absent, 0)
        return rbm._free_energy(absent) - rbm._free_energy(present)

    def one_copy() -> Any:
        """For each class, compare the scene with the class added and the unchanged scene.

        The result is valid only for absent classes.
        """
        present = np.repeat(v.numpy(), V, axis=0)
        np.fill_diagonal(present, 1)
        return rbm._free_energy(v.numpy()) - rbm._free_energy(present)

    timings = interleave(
        {OURS: prepared, UNPREPARED: unprepared, TWO_COPIES: two_copies, ONE_COPY: one_copy},
        rounds=rounds,
    )
    absent = v[0] == 0
    difference = prepared()[absent] - torch.from_numpy(two_copies())[absent]
    return Result(
        name="log-odds",
        title=f"Log-odds of {V} objects for one scene, {H} hidden units, one thread",
        subject=OURS,
        timings=timings,
        targets={TWO_COPIES: 50},
        facts={"largest difference from scikit-learn": float(difference.abs().max())},
    )
