"""scikit-learn's `BernoulliRBM` on objects alone, scored by its exact log-odds.

The trained weights are put into our own machine without relation units, whose energy is the same,
so that both models are scored by one piece of code.
"""

from __future__ import annotations

import torch
from sklearn.neural_network import BernoulliRBM
from torch import Tensor

from app.boltzmann import BoltzmannMachine, MachineSpec, build


def fit_bernoulli_rbm(
    v: Tensor, *, hidden: int = 200, learning_rate: float = 0.05, epochs: int = 60, seed: int = 0
) -> BoltzmannMachine:
    """Train by scikit-learn's persistent CD-1.

    Args:
        v: (N, V) binary presence.
        hidden: H1.
        learning_rate, epochs: as scikit-learn's `learning_rate` and `n_iter`; batches of 10.
    """
    rbm = BernoulliRBM(
        n_components=hidden, learning_rate=learning_rate, n_iter=epochs, random_state=seed
    ).fit(v.numpy())
    machine = build(MachineSpec("rbm", V=v.shape[1], A=1, H1=hidden))
    with torch.no_grad():
        machine.b.copy_(torch.as_tensor(rbm.intercept_visible_))
        machine.c1.copy_(torch.as_tensor(rbm.intercept_hidden_))
        machine.W.copy_(torch.as_tensor(rbm.components_.T))
    return machine
