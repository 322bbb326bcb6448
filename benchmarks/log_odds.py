"""Benchmark of missing objects: time to compute the log-odds of all classes for one scene."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from torch import Tensor

from app.inference.objects import ObjectScorer
from app.inference.relation_units import encode
from benchmarks.report import Result
from benchmarks.timing import interleave
from benchmarks.yardsticks import object_machine, presence, random_scenes, scikit_learn
from training.machines import MachineSpec, weights_of

OURS, UNPREPARED = "ours, exp(W) precomputed", "ours, from the weights alone"
TWO_COPIES = "scikit-learn, 2 V copies"
ONE_COPY = "scikit-learn, V + 1 copies"


@torch.inference_mode()
def log_odds(*, V: int = 417, H: int = 200, objects: int = 12, rounds: int = 31) -> Result:
    """Time the closed form of a machine, and scikit-learn with one scene copy per class.

    Relations have no effect on objects. With binary hidden units and no couplings, the log-odds
    therefore equal those of a plain RBM such as scikit-learn's. The machine has V classes and H
    hidden units. Each of the rounds times every method.
    """
    machine = object_machine(MachineSpec("rbm", V=V, A=4, units=H), objects)
    weights, rbm = weights_of(machine), scikit_learn(machine)
    scorer = ObjectScorer(weights)
    scene = random_scenes(1, V, objects, torch.Generator().manual_seed(1))
    v, classes = presence(scene, V), scene[0].numpy()
    ones, zeros = np.ones(objects, np.float32), np.zeros(objects, np.float32)

    def prepared() -> Any:
        x = encode(weights, classes, ones, zeros).x
        return scorer.absent(x, classes, ones, None, coverage=1.0)

    def unprepared() -> Tensor:
        return machine.object_log_odds(v)

    def two_copies() -> Any:
        """Compare, for each class, the scene with the class and without it."""
        present = np.repeat(v.numpy(), V, axis=0)
        absent = present.copy()
        np.fill_diagonal(present, 1)
        np.fill_diagonal(absent, 0)
        return rbm._free_energy(absent) - rbm._free_energy(present)

    def one_copy() -> Any:
        """Compare, for each absent class, the scene with the class and the unchanged scene."""
        present = np.repeat(v.numpy(), V, axis=0)
        np.fill_diagonal(present, 1)
        return rbm._free_energy(v.numpy()) - rbm._free_energy(present)

    timings = interleave(
        {OURS: prepared, UNPREPARED: unprepared, TWO_COPIES: two_copies, ONE_COPY: one_copy},
        rounds=rounds,
    )
    absent = v[0].numpy() == 0
    difference = prepared()[absent] - two_copies()[absent]
    return Result(
        title=f"Log-odds of {V} objects for one scene, {H} hidden units, one thread",
        subject=OURS,
        timings=timings,
        targets={TWO_COPIES: 50},
        facts={"largest difference from scikit-learn": float(np.abs(difference).max())},
    )
