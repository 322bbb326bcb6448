"""Residual weights of single relation triples, fitted after the shared weights."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import torch
from jaxtyping import Float, Int
from scipy.special import expit
from torch import Tensor

from app.scene.spatial_relations import STACKED
from training.datasets.batches import Batch, SceneTensors, relation_units
from training.machines import BoltzmannMachine, build
from training.machines.edges import triple_keys

# Precision τ of the normal prior of a residual weight: that of four scenes with p(r) = 1/2.
_PRECISION = 1.0
# Minimum number of scenes with an annotation of a triple, and minimum size of a stored residual.
_SPEAKING_SCENES = 2
_LEAST_RESIDUAL = 0.1
_NEWTON_STEPS = 12
_BATCH = 64
# Change of the log-odds of a relation in which training shows a class in no scene, and the minimum
# number of scenes that annotate such relations of the class. Fewer scenes show nothing.
_UNSEEN_ROLE = -6.0
_CHANCES = 10


@torch.no_grad()
def means_of_parts(
    machine: BoltzmannMachine, batch: Batch, generator: torch.Generator
) -> Float[Tensor, "B H1"]:
    """Return the means of h1 given random parts of scenes, half of them with the room type."""
    probability = torch.rand(len(batch), 1, generator=generator)
    listed = batch.v * (torch.rand(batch.v.shape, generator=generator) < probability)
    lists_room = torch.rand(len(batch), generator=generator) < 0.5
    x = machine.hidden_logits(listed, torch.where(lists_room, batch.room, -1))
    return machine.state_means(x)


@torch.no_grad()
def lower_unseen_roles(
    machine: BoltzmannMachine, train: SceneTensors, parents: Int[Tensor, "V"]
) -> None:
    """Lower the weights of classes that no training scene shows on, in or above an object."""
    # Factors extrapolate: they put windows on tables. Roles of the parent and of kinds count.
    seen = np.zeros((2, machine.spec.A, machine.spec.V), dtype=np.bool_)
    chances = np.zeros(seen.shape, dtype=np.int64)
    for scene in train.scenes:
        relation, subject, object_ = scene.evidence.holds.nonzero()
        classes = scene.evidence.classes
        seen[0, relation, classes[subject]] = seen[1, relation, classes[object_]] = True
        for role, partners in ((0, 2), (1, 1)):
            chances[role][:, classes] += scene.evidence.observed.any(partners)
    parent_of, own = parents.numpy(), seen.copy()
    for kind in np.flatnonzero(parent_of >= 0).tolist():
        seen[..., parent_of[kind]] |= own[..., kind]
        seen[..., kind] |= own[..., parent_of[kind]]
    unseen = torch.from_numpy(~seen & (chances >= _CHANCES))
    for a in STACKED:
        if a < machine.spec.A:
            machine.get_parameter("s")[a, unseen[0, a]] += _UNSEEN_ROLE
            machine.get_parameter("o")[a, unseen[1, a]] += _UNSEEN_ROLE


@torch.no_grad()
def with_counted_residuals(
    machine: BoltzmannMachine,
    train: SceneTensors,
    offsets: Float[Tensor, "sources A"],
    source_weights: Float[Tensor, "sources"],
) -> BoltzmannMachine:
    """Return the machine with fitted residual weights of single triples.

    Shared factors can give a false relation a high probability (a window on a stove). Newton's
    method fits a change δ_e of the residual weight w_e' of each triple e = (a,i,j) with enough
    annotations. All other weights are fixed. It maximises

        sum over scenes of log p(r_e | v, E[h1 | v], w_e' + δ_e) - τ/2 δ_e².

    As in training, the hidden units depend on a random subset of the objects, and each data source
    corrects the logits by its offsets.
    """
    V, columns = machine.spec.V, []
    generator = torch.Generator().manual_seed(0)
    for index in torch.arange(len(train)).split(_BATCH):
        batch = train.batch(index)
        edges, r, observed = relation_units(machine, batch)
        h1 = means_of_parts(machine, batch, generator)
        logits = machine.relation_logits(edges, batch.v, h1)
        logits = logits + offsets[batch.source].gather(1, edges.relation)
        annotated = (observed * machine.gate(edges, batch.v)) > 0
        key = triple_keys(edges.relation, edges.subject, edges.object, V)
        weight = source_weights[batch.source].unsqueeze(1).expand_as(logits)
        columns.append([values[annotated] for values in (key, logits, r, weight)])
    keys, logits, r, weight = (torch.cat(blocks) for blocks in zip(*columns, strict=True))
    z, holds, weights = (values.double().numpy() for values in (logits, r, weight))
    triples, which, counts = np.unique(keys.numpy(), return_inverse=True, return_counts=True)
    delta = np.zeros(len(triples))
    for _ in range(_NEWTON_STEPS):
        p = expit(z + delta[which])
        slope = np.bincount(which, weights * (holds - p), len(triples)) - _PRECISION * delta
        curvature = np.bincount(which, weights * p * (1 - p), len(triples)) + _PRECISION
        delta += (slope / curvature).clip(-2, 2)
    residuals = dict(
        zip(machine.triple_keys.tolist(), machine.get_parameter("residual").tolist(), strict=True)
    )
    kept = (counts >= _SPEAKING_SCENES) & (np.abs(delta) >= _LEAST_RESIDUAL)
    for key, value in zip(triples[kept].tolist(), delta[kept].tolist(), strict=True):
        residuals[key] = residuals.get(key, 0.0) + value
    table = torch.tensor(sorted(residuals), dtype=torch.int64)
    state = machine.state_dict()
    state["triples"] = torch.stack([table // V // V, table // V % V, table % V], 1).int()
    state["residual"] = torch.tensor([residuals[key] for key in table.tolist()])
    larger = build(replace(machine.spec, T=len(table)))
    larger.load_state_dict(state)
    return larger
