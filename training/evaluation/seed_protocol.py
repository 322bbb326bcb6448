"""The seed paper's own protocol: every question answered by one stochastic reconstruction.

The hidden layers are drawn once (h1 from its mean-field field, exact with one layer) and the units
asked about once given h1. No ranking, no threshold: a coin flip is the answer. The figures say how
a model does on the paper's terms; they are reported for that alone, for they leak and reward
switching much on:

    T1  share of labelled relations that are switched on, all objects given. Nothing is charged for
        units that are switched on beside them, hence their number.
    T2  share of removed objects that are switched on again. As published the object's relations
        stay on: in a gated machine they hold it, so that the answer is given away; elsewhere they
        tell the context, and the GBM's two-way weights the object. Once more with them deleted.
    T3  mean over classes of |reconstruction - scene| after a class was added. A model that returns
        what it was given is wrong in one class out of V: it scores 1/V.

The split is random by scene, so near-duplicates of test scenes are in the training part.

Source: Bozcan, Oymak, Alemdar, Kalkan, "What is (missing or wrong) in the scene?", ICRA 2018.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import torch
from torch import Tensor

from training.batches import Batch, SceneTensors, relation_units
from training.cases import scene_rng
from training.evaluation.intruders import draw_intruders
from training.evaluation.metrics import Metric, Ratio
from training.evaluation.setting import Contender, Outcome, Setting
from training.machines import BoltzmannMachine
from training.machines.bernoulli import bernoulli
from training.machines.edges import Edges
from training.machines.mean_field import Evidence, mean_field

PAPER: dict[str, dict[str, float]] = {
    "T1 labelled relations switched on": {"RBM": 0.0560, "GBM": 0.1418, "Triway": 0.2335},
    "T2 removed objects switched on, relations left on": {
        "RBM": 0.3512,
        "GBM": 0.4094,
        "Triway": 0.4328,
    },
    "T3 error measure": {"RBM": 0.6446, "GBM": 0.1404, "Triway": 0.0789, "doing nothing": 1 / 417},
}
"""What the paper reports, on its own data."""

_BLOCK = 32


def relations_switched_on(contender: Contender, setting: Setting) -> Outcome | None:
    """T1: relations start unobserved, and are drawn once."""
    if contender.machine is None:
        return None
    scenes = setting.some(related=True)
    if not len(scenes):
        return None
    on, labelled, hit = (np.zeros(len(scenes)) for _ in range(3))
    for index, batch, generator in _blocks(scenes, setting.seed):
        total, grid = draw_relations(contender.machine, batch, generator)
        place = index.numpy()
        on[place] = total.double().numpy()
        labelled[place] = batch.holds.sum((1, 2, 3)).double().numpy()
        hit[place] = (batch.holds * grid).sum((1, 2, 3)).double().numpy()
    metrics: dict[str, Metric] = {
        "labelled relations switched on": Ratio(hit, labelled),
        "relations switched on per scene": Ratio.of_scenes(on),
        "labelled relations per scene": Ratio.of_scenes(labelled),
    }
    return Outcome(metrics, len(scenes), 0)


def removed_switched_on(contender: Contender, setting: Setting) -> Outcome | None:
    """T2: one class of each scene, drawn at random, is removed and its unit drawn again."""
    if contender.machine is None:
        return None
    scenes = setting.some(related=True)
    targets = _targets(scenes, setting.structure, setting.seed)
    asked = targets >= 0
    if not bool(asked.any()):
        return None
    metrics: dict[str, Metric] = {}
    for name, left_on in (("relations left on", True), ("relations deleted", False)):
        drawn = torch.zeros(len(scenes))
        for index, batch, generator in _blocks(scenes, setting.seed):
            some = asked[index].nonzero().squeeze(1)
            if len(some):
                chosen = targets[index[some]]
                p = switch_on_probability(
                    contender.machine, batch.rows(some), chosen, left_on, generator
                )
                drawn[index[some]] = bernoulli(p, generator)
        metrics[f"removed objects switched on, {name}"] = Ratio(
            drawn.double().numpy(), asked.double().numpy()
        )
    return Outcome(metrics, len(scenes), int((~asked).sum()))


def reconstruction_after_addition(contender: Contender, setting: Setting) -> Outcome | None:
    """T3: all objects drawn again after one absent class was added; relations unobserved."""
    if contender.machine is None:
        return None
    machine, scenes = contender.machine, setting.some()
    added = draw_intruders(scenes, setting.structure, seed=setting.seed)
    asked = (added >= 0).double().numpy()
    if not asked.any():
        return None
    V = scenes.v.shape[1]
    wrong, off, kept, there = (np.zeros(len(scenes)) for _ in range(4))
    for index, batch, generator in _blocks(scenes, setting.seed):
        intruder = added[index].clamp(min=0).unsqueeze(1)
        h1 = _draw_h1(machine, Evidence(batch.v.scatter(1, intruder, 1.0)), generator)
        v = bernoulli(machine.object_logits(h1).sigmoid(), generator)
        place = index.numpy()
        weight = asked[place]
        wrong[place] = (v - batch.v).abs().sum(1).double().numpy() * weight
        off[place] = (1 - v.gather(1, intruder).squeeze(1)).double().numpy() * weight
        kept[place] = (v * batch.v).sum(1).double().numpy() * weight
        there[place] = batch.v.sum(1).double().numpy() * weight
    metrics: dict[str, Metric] = {
        "error measure": Ratio(wrong, asked * V),
        "error measure, doing nothing": Ratio(asked, asked * V),
        "added objects switched off": Ratio(off, asked),
        "objects of the scene kept on": Ratio(kept, there),
    }
    return Outcome(metrics, len(scenes), int((asked == 0).sum()))


@torch.no_grad()
def draw_relations(
    machine: BoltzmannMachine, batch: Batch, generator: torch.Generator
) -> tuple[Tensor, Tensor]:
    """One draw of all relations given the objects: units on (B,), and those between (B, A, n, n).

    Units of absent objects, which machines without gates switch on as well, count in the first.
    """
    h1 = _draw_h1(machine, Evidence(batch.v), generator)
    edges = machine.edges(batch.classes, batch.counts)
    p = machine.relation_logits(edges, batch.v, h1).sigmoid() * machine.gate(edges, batch.v)
    r = bernoulli(p, generator)
    return r.sum(1), machine.between(edges, r, batch.classes).clamp(min=0)


@torch.no_grad()
def switch_on_probability(
    machine: BoltzmannMachine,
    batch: Batch,
    target: Tensor,
    left_on: bool,
    generator: torch.Generator,
) -> Tensor:
    """p(v_i = 1 | one draw of h1, relations), (B,), of a class i that was removed from each scene.

    Args:
        target: (B,) int64.
        left_on: the relations of i stay as annotated; otherwise they are unobserved.
    """
    place = target.unsqueeze(1)
    absent, there = batch.v.scatter(1, place, 0.0), batch.v.scatter(1, place, 1.0)
    edges, r, observed = relation_units(machine, batch)
    if not left_on:
        touched = _touches(edges, target)
        r, observed = r * ~touched, observed & ~touched
    h1 = _draw_h1(machine, Evidence(absent, edges, r, observed), generator)
    logit = machine.object_logits(h1).gather(1, place).squeeze(1)
    for v, sign in ((there, 1.0), (absent, -1.0)):
        logits, gate = machine.relation_logits(edges, v, h1), machine.gate(edges, v)
        logit = logit + sign * machine.relation_term(logits, gate, r, observed).sum(-1)
    # A relation that is on and may be on with i alone leaves i no choice.
    held = (observed * r > machine.gate(edges, absent)).any(-1)
    return torch.where(held, torch.inf, logit).sigmoid()


def _draw_h1(machine: BoltzmannMachine, evidence: Evidence, generator: torch.Generator) -> Tensor:
    with torch.no_grad():
        return bernoulli(mean_field(machine, evidence).y.sigmoid(), generator)


def _touches(edges: Edges, target: Tensor) -> Tensor:
    """(B, E) bool: units that the class has to do with."""
    i = target.unsqueeze(1)
    return ((edges.subject == i) | (edges.object == i)) & edges.valid


def _targets(scenes: SceneTensors, structure: Tensor, seed: int) -> Tensor:
    """A removable class of each scene, (N,); -1 where it has fewer than two."""
    found = torch.full((len(scenes),), -1, dtype=torch.int64)
    plain = ~structure.numpy()
    for k, scene in enumerate(scenes.scenes):
        removable = scene.evidence.classes[plain[scene.evidence.classes]]
        if len(removable) >= 2:
            found[k] = int(scene_rng(scene, seed).choice(removable))
    return found


def _blocks(scenes: SceneTensors, seed: int) -> Iterator[tuple[Tensor, Batch, torch.Generator]]:
    """(positions, batch, random numbers) block by block."""
    generator = torch.Generator().manual_seed(seed)
    for index in torch.arange(len(scenes)).split(_BLOCK):
        yield index, scenes.batch(index), generator
