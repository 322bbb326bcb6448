"""Weights of single triples of a Triway machine, smoothed towards counts.

Shared factors say what a relation means across classes, and say too much of pairs that many scenes
show not to stand so (a window on a stove). So after training each triple e = (a,i,j) that enough
scenes speak of gets a weight of its own: the maximum of

    sum over scenes of log p(r_e | v, E[h1 | v], w_e' + δ_e) - τ/2 δ_e²

by Newton's method, all other weights as they are and the context seeing a random share of the
objects, as in training. The fewer scenes speak of a triple, the nearer its δ stays to 0.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from training.batches import SceneTensors, relation_units
from training.machines import BoltzmannMachine, build
from training.machines.mean_field import Evidence, mean_field
from training.objectives.relations import partly_shown

# τ: so many scenes at even odds would weigh four times as much.
_PRECISION = 1.0
# Scenes that must speak of a triple, and the least weight that is worth keeping.
_SCENES = 5
_LEAST = 0.1
_STEPS = 12
_BATCH = 64


def with_counted_residuals(
    machine: BoltzmannMachine, train: SceneTensors, offsets: Tensor, source_weights: Tensor
) -> BoltzmannMachine:
    """A Triway machine with the weights of its triples fitted; any other machine as it is.

    Args:
        train: scenes of which relations are known.
        offsets: (sources, A), added to the logits of each source's scenes.
        source_weights: (sources,) what a relation of each source counts for.
    """
    if not machine.has_residuals:
        return machine
    keys, logits, holds, weights = _known_units(machine, train, offsets, source_weights)
    triples, which, counts = np.unique(keys, return_inverse=True, return_counts=True)
    delta = np.zeros(len(triples))
    for _ in range(_STEPS):
        p = 1 / (1 + np.exp(-(logits + delta[which])))
        slope = np.bincount(which, weights * (holds - p), len(triples)) - _PRECISION * delta
        curvature = np.bincount(which, weights * p * (1 - p), len(triples)) + _PRECISION
        delta += (slope / curvature).clip(-2, 2)
    before = machine.get_parameter("residual").tolist()
    old = dict(zip(machine.triple_keys.tolist(), before, strict=True))
    kept = (counts >= _SCENES) & (np.abs(delta) >= _LEAST)
    for key, value in zip(triples[kept].tolist(), delta[kept].tolist(), strict=True):
        old[key] = old.get(key, 0.0) + value
    return _with_residuals(machine, old)


@torch.no_grad()
def _known_units(
    machine: BoltzmannMachine, train: SceneTensors, offsets: Tensor, source_weights: Tensor
) -> tuple[NDArray[np.int64], NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """Keys (U,), logits, values and weights of all known units."""
    columns: list[list[Tensor]] = [[], [], [], []]
    V = machine.spec.V
    generator = torch.Generator().manual_seed(0)
    for index in torch.arange(len(train)).split(_BATCH):
        batch = train.batch(index)
        edges, r, observed = relation_units(machine, batch)
        h1 = mean_field(machine, Evidence(partly_shown(batch.v, generator))).y.sigmoid()
        logits = machine.relation_logits(edges, batch.v, h1)
        logits = logits + offsets[batch.source].gather(1, edges.relation)
        known = (observed * machine.gate(edges, batch.v)) > 0
        key = (edges.relation * V + edges.subject) * V + edges.object
        weight = source_weights[batch.source].unsqueeze(1).expand_as(logits)
        for column, values in zip(columns, (key, logits, r, weight), strict=True):
            column.append(values[known])
    key, logits, r, weight = (torch.cat(column) for column in columns)
    return key.numpy(), logits.double().numpy(), r.double().numpy(), weight.double().numpy()


def _with_residuals(machine: BoltzmannMachine, residuals: dict[int, float]) -> BoltzmannMachine:
    V = machine.spec.V
    keys = torch.tensor(sorted(residuals), dtype=torch.int64)
    triples = torch.stack([keys // V // V, keys // V % V, keys % V], 1).to(torch.int32)
    larger = build(replace(machine.spec, T=len(keys)))
    state = machine.state_dict()
    state["triples"] = triples
    state["residual"] = torch.tensor([residuals[key] for key in keys.tolist()])
    larger.load_state_dict(state)
    return larger
