"""Gibbs sampling of objects and hidden units for training and for tests of the machine.

A sweep draws h1 given v, and then the classes given h1, with couplings one after another:

    p(v_i = 1 | h1, other classes) = sigmoid(b_i + a_qi + u_qi + Y_ti + W_i·h1 + (vL)_i)

Relations are summed out: their sum is 1. The service has compiled kernels (`app.inference.chains`).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from training.machines.machine import BoltzmannMachine


@dataclass
class Chains:
    """The state of B Gibbs chains."""

    v: Float[Tensor, "B V"]
    room: Int[Tensor, "B"]  # -1: no room type
    source: Int[Tensor, "B"]  # data source; -1: none
    possible: Bool[Tensor, "B V"]  # classes that the chain may switch on


@torch.no_grad()
def sweep(
    machine: BoltzmannMachine,
    chains: Chains,
    generator: torch.Generator,
    *,
    classes: int | None = None,
) -> None:
    """Run one Gibbs sweep, in place. It draws some random coupled `classes`, by default all."""
    h1 = draw_states(machine.hidden_logits(chains.v, chains.room), machine.spec.states, generator)
    bias = machine.scene_bias(chains.source) + machine.room_bias(chains.room)
    field = bias + h1 @ machine.W.T
    if (couplings := machine.couplings) is None:
        chains.v = torch.bernoulli(field.sigmoid(), generator=generator) * chains.possible
    else:
        chains.v = _draw_coupled(chains, field, couplings, classes, generator)


def draw_states(
    x: Float[Tensor, "B H1"], states: int, generator: torch.Generator
) -> Float[Tensor, "B H1"]:
    """Draw the states h1 from the logits x, in which the first state of a unit has no entry."""
    if states == 2:
        return torch.bernoulli(x.sigmoid(), generator=generator)
    logits = x.unflatten(-1, (-1, states - 1))
    odds = torch.cat([torch.zeros_like(logits[..., :1]), logits], -1).softmax(-1)
    cumulative = odds.cumsum(-1)[..., :-1]
    uniform = torch.rand(*odds.shape[:-1], 1, generator=generator, dtype=x.dtype)
    state = (uniform >= cumulative).sum(-1)
    return torch.nn.functional.one_hot(state, states)[..., 1:].flatten(-2).to(x.dtype)


def _draw_coupled(
    chains: Chains,
    field: Float[Tensor, "B V"],
    couplings: Float[Tensor, "V V"],
    classes: int | None,
    generator: torch.Generator,
) -> Float[Tensor, "B V"]:
    """Draw some random classes (None: all), one after another given all other classes."""
    # numpy has a smaller overhead than torch for the many small steps.
    order = torch.randperm(field.shape[1], generator=generator)[:classes].tolist()
    uniform = torch.rand(len(order), len(field), generator=generator, dtype=field.dtype).numpy()
    v, field_of_class = chains.v.T.numpy().copy(), field.T.numpy()  # (classes, chains)
    possible, L = chains.possible.T.numpy(), couplings.numpy()
    for u, i in zip(uniform, order, strict=True):
        logit = np.maximum(field_of_class[i] + L[i] @ v, -80)  # e^89 overflows float32
        v[i] = (u * (1 + np.exp(-logit)) < 1) & possible[i]  # u < sigmoid(logit)
    return torch.from_numpy(v.T.copy())
