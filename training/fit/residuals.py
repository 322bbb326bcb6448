"""Residual weights of single relation triples, fitted after the shared weights."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import torch
from torch import Tensor

from app.scene.relations import STACKED
from training.datasets.array_types import Floats, Ints
from training.datasets.batches import SceneTensors, relation_units
from training.fit.parts import means_of_parts
from training.machines import BoltzmannMachine, build

# Precision τ of the normal prior of a residual weight. A scene with p(r) = 1/2 has the Fisher
# information 1/4, so the prior has the weight of four such scenes.
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
def lower_unseen_roles(machine: BoltzmannMachine, train: SceneTensors, parents: Tensor) -> None:
    """Lower the weights of classes that no training scene shows on, in or above an object.

    Factors extrapolate: they put windows on tables. A class has a role, as the subject or as the
    object of a stacked relation, if a scene shows it, its parent or one of its kinds in this role.
    Classes with few annotated relations keep their weights.

    Args:
        parents: (classes,) index of the parent of each class, -1 without a parent.
    """
    seen = np.zeros((2, machine.spec.A, machine.spec.V), dtype=np.bool_)
    chances = np.zeros((2, machine.spec.A, machine.spec.V), dtype=np.int64)
    for scene in train.scenes:
        relation, subject, object_ = scene.evidence.holds.nonzero()
        classes = scene.evidence.classes
        seen[0, relation, classes[subject]] = seen[1, relation, classes[object_]] = True
        chances[0][:, classes] += scene.evidence.observed.any(2)
        chances[1][:, classes] += scene.evidence.observed.any(1)
    kinds = np.flatnonzero(parents.numpy() >= 0)
    of_kind = seen[:, :, kinds]
    of_parent = seen[:, :, parents.numpy()[kinds]]
    for role in range(2):
        for a in range(machine.spec.A):
            np.logical_or.at(seen[role, a], parents.numpy()[kinds], of_kind[role, a])
    seen[:, :, kinds] |= of_parent
    seen |= chances < _CHANCES
    for name, role in (("s", seen[0]), ("o", seen[1])):
        for a in STACKED:
            if a < machine.spec.A:
                machine.get_parameter(name)[a, torch.from_numpy(~role[a])] += _UNSEEN_ROLE


def with_counted_residuals(
    machine: BoltzmannMachine, train: SceneTensors, offsets: Tensor, source_weights: Tensor
) -> BoltzmannMachine:
    """Return the machine with fitted residual weights of single triples.

    All classes share the factors of a relation. For some pairs of classes, the factors give a high
    probability although the relation is false in many scenes (a window on a stove). After training,
    this function therefore fits a change δ_e of the residual weight w_e' of each triple e = (a,i,j)
    that enough scenes annotate. Newton's method maximises

        sum over scenes of log p(r_e | v, E[h1 | v], w_e' + δ_e) - τ/2 δ_e².

    All other weights are fixed. As in training, the hidden units depend on a random subset of the
    objects. With few scenes, δ_e stays close to 0.

    Args:
        offsets: corrections of the logits for each data source, (sources, relations).
        source_weights: weight of a relation from each data source, (sources,).
    """
    keys, logits, holds, weights = _annotated_units(machine, train, offsets, source_weights)
    triples, which, counts = np.unique(keys, return_inverse=True, return_counts=True)
    delta = np.zeros(len(triples))
    for _ in range(_NEWTON_STEPS):
        p = 1 / (1 + np.exp(-(logits + delta[which])))
        slope = np.bincount(which, weights * (holds - p), len(triples)) - _PRECISION * delta
        curvature = np.bincount(which, weights * p * (1 - p), len(triples)) + _PRECISION
        delta += (slope / curvature).clip(-2, 2)
    before = machine.get_parameter("residual").tolist()
    residuals = dict(zip(machine.triple_keys.tolist(), before, strict=True))
    kept = (counts >= _SPEAKING_SCENES) & (np.abs(delta) >= _LEAST_RESIDUAL)
    for key, value in zip(triples[kept].tolist(), delta[kept].tolist(), strict=True):
        residuals[key] = residuals.get(key, 0.0) + value
    return _with_residuals(machine, residuals)


@torch.no_grad()
def _annotated_units(
    machine: BoltzmannMachine, train: SceneTensors, offsets: Tensor, source_weights: Tensor
) -> tuple[Ints, Floats, Floats, Floats]:
    """Return keys, logits, values and weights of all annotated relations, each (relations,)."""
    columns: list[list[Tensor]] = [[], [], [], []]
    V = machine.spec.V
    generator = torch.Generator().manual_seed(0)
    for index in torch.arange(len(train)).split(_BATCH):
        batch = train.batch(index)
        edges, r, observed = relation_units(machine, batch)
        h1 = means_of_parts(machine, batch, generator)
        logits = machine.relation_logits(edges, batch.v, h1)
        logits = logits + offsets[batch.source].gather(1, edges.relation)
        annotated = (observed * machine.gate(edges, batch.v)) > 0
        key = (edges.relation * V + edges.subject) * V + edges.object
        weight = source_weights[batch.source].unsqueeze(1).expand_as(logits)
        for column, values in zip(columns, (key, logits, r, weight), strict=True):
            column.append(values[annotated])
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
