"""Reconstruction error of objects and relations, as in the training curves of Bozcan et al. (2018).

The error uses one deterministic up–down pass. The up pass computes the mean of the hidden layer h1
given the scene, with the annotated relations observed. The down pass computes p(v | h1) for objects
v and p(r | v, h1) for relations r. The object error is the mean of |v - p(v | h1)| over classes.
The relation error is the mean of |r - p(r | v, h1)| over observed relations of present objects.
"""

from __future__ import annotations

import torch

from training.datasets.batches import SceneTensors, relation_units
from training.machines import BoltzmannMachine
from training.machines.mean_field import Evidence, mean_field

# Number of scenes to reconstruct, and to reconstruct at a time.
_SCENES, _BLOCK = 512, 64


@torch.no_grad()
def reconstruction_error(machine: BoltzmannMachine, scenes: SceneTensors) -> tuple[float, float]:
    """Return (object error, relation error) of random scenes; NaN without observed relations."""
    object_sum = relation_sum = 0.0
    objects = relations = 0
    sample = torch.randperm(len(scenes), generator=torch.Generator().manual_seed(0))[:_SCENES]
    for index in sample.split(_BLOCK):
        batch = scenes.batch(index)
        edges, r, observed = relation_units(machine, batch)
        field = mean_field(machine, Evidence(batch.v, edges, r, observed, batch.room))
        h1 = field.y.sigmoid()
        object_sum += float((batch.v - machine.object_logits(h1).sigmoid()).abs().sum())
        objects += batch.v.numel()
        weight = observed * machine.gate(edges, batch.v)
        p = machine.relation_logits(edges, batch.v, h1).sigmoid()
        relation_sum += float(((r - p).abs() * weight).sum())
        relations += int(weight.sum())
    return object_sum / max(objects, 1), relation_sum / relations if relations else float("nan")
