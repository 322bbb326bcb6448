"""scikit-learn's `BernoulliRBM` on objects alone, scored by its exact log-odds.

The trained weights are put into our own machine without relation units, whose energy is the same,
so that both models are scored by one piece of code.
"""

from __future__ import annotations

import numpy as np
import torch
from sklearn.neural_network import BernoulliRBM
from torch import Tensor

from training.baselines.fitting import Proposals
from training.batches import SceneTensors
from training.evaluation.missing import ObjectScore, machine_score
from training.machines import BoltzmannMachine, MachineSpec, build

_HIDDEN = 200
# Too high a rate makes persistent CD fall back to popularity, without any error.
_LEARNING_RATES = (0.1, 0.2, 0.4)
_EPOCHS = 60
_BATCH = 32


def fit_annealed(
    v: Tensor, *, hidden: int, learning_rate: float, epochs: int, seed: int
) -> BoltzmannMachine:
    """Train by scikit-learn's updates (`partial_fit`) while the rate falls linearly to 0.

    Persistent chains follow a model that stands still in the end: on the indoor scenes' validation
    part 40 passes so reach an MRR of .411; at a constant rate it is .377 after 10 passes and .378
    after 20. Batches are drawn anew in each pass; what does not fill one waits for another pass.

    Args:
        v: (N, V) binary presence.
        hidden: H1.
        learning_rate: at the start.
        epochs: passes over the data.
    """
    size = min(_BATCH, len(v))
    rbm = BernoulliRBM(n_components=hidden, batch_size=size, random_state=seed)
    order = np.random.default_rng(seed)
    for epoch in range(epochs):
        rbm.set_params(learning_rate=learning_rate * (1 - epoch / epochs))
        whole = order.permutation(len(v))[: len(v) // size * size]
        for index in whole.reshape(-1, size):
            rbm.partial_fit(v[index].numpy())
    return _as_machine(rbm)


def _as_machine(rbm: BernoulliRBM) -> BoltzmannMachine:
    hidden, V = rbm.components_.shape
    machine = build(MachineSpec("rbm", V=V, A=1, H1=hidden))
    with torch.no_grad():
        machine.b.copy_(torch.as_tensor(rbm.intercept_visible_))
        machine.c1.copy_(torch.as_tensor(rbm.intercept_hidden_))
        machine.W.copy_(torch.as_tensor(rbm.components_.T))
    return machine


def propose(train: SceneTensors, _structure: Tensor, seed: int) -> Proposals[ObjectScore]:
    """Learning rates."""
    for rate in _LEARNING_RATES:
        machine = fit_annealed(
            train.v, hidden=_HIDDEN, learning_rate=rate, epochs=_EPOCHS, seed=seed
        )
        yield {"learning_rate": rate, "epochs": _EPOCHS}, machine_score(machine)
