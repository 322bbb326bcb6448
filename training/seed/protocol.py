"""Seed protocol: the evaluation protocol of Bozcan et al. (2018), the paper behind this project.

One random reconstruction of a scene answers each question. First the hidden layer h1 is sampled
once from its mean field, which is exact for a machine with one hidden layer. Then the queried units
are sampled once given h1. The sample is the answer, without any ranking or threshold.

    T1  share of labelled relations that the sample switches on, given all objects. Switching on
        other relations costs nothing, so the number of all relations switched on is also reported
    T2  share of removed objects that the sample switches on again. In the published protocol, the
        relations of the removed object stay on. In a gated machine, these relations force the
        object on. In other machines, these relations affect the hidden layer. In the GBM, two-way
        weights between relations and objects also raise the object. A second variant of T2 deletes
        these relations
    T3  mean over classes of |reconstruction - scene| after a class was added. A model that returns
        its input is wrong in one of V classes and scores 1/V

Use these metrics only for comparison with the paper. They leak information and reward machines that
switch on many units. The split is random by scene, so the training part contains near-duplicates of
test scenes.

Source: Bozcan, Oymak, Alemdar, Kalkan, "What is (missing or wrong) in the scene?", ICRA 2018.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import torch
from torch import Tensor

from training.datasets.batches import Batch, SceneTensors, relation_units
from training.datasets.cases import scene_rng
from training.evaluation.intruders import draw_intruders
from training.evaluation.metrics import Metric, Ratio
from training.evaluation.model import Model
from training.evaluation.setting import Outcome, Setting
from training.evaluation.tasks import Task
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
"""Results of Bozcan et al. (2018) on their own data, by metric and machine."""

_BLOCK = 32


def relations_switched_on(model: Model, setting: Setting) -> Outcome | None:
    """Measure T1: all relations are unobserved, and each relation is sampled once."""
    if model.machine is None:
        return None
    scenes = setting.some(related=True)
    if not len(scenes):
        return None
    on, labelled, hit = (np.zeros(len(scenes)) for _ in range(3))
    for index, batch, generator in _blocks(scenes, setting.seed):
        total, grid = draw_relations(model.machine, batch, generator)
        on[index] = total.double().numpy()
        labelled[index] = batch.holds.sum((1, 2, 3)).double().numpy()
        hit[index] = (batch.holds * grid).sum((1, 2, 3)).double().numpy()
    metrics: dict[str, Metric] = {
        "labelled relations switched on": Ratio(hit, labelled),
        "relations switched on per scene": Ratio.of_scenes(on),
        "labelled relations per scene": Ratio.of_scenes(labelled),
    }
    return Outcome(metrics, len(scenes), 0)


def removed_switched_on(model: Model, setting: Setting) -> Outcome | None:
    """Measure T2: remove one random class from each scene, and sample the unit of this class."""
    if model.machine is None:
        return None
    scenes = setting.some(related=True)
    targets = _targets(scenes, setting.structure, setting.seed)
    has_target = targets >= 0
    if not bool(has_target.any()):
        return None
    metrics: dict[str, Metric] = {}
    for name, left_on in (("relations left on", True), ("relations deleted", False)):
        switched_on = torch.zeros(len(scenes))
        for index, batch, generator in _blocks(scenes, setting.seed):
            rows = has_target[index].nonzero().squeeze(1)
            if len(rows):
                classes = targets[index[rows]]
                p = switch_on_probability(
                    model.machine, batch.rows(rows), classes, left_on, generator
                )
                switched_on[index[rows]] = bernoulli(p, generator)
        metrics[f"removed objects switched on, {name}"] = Ratio(
            switched_on.double().numpy(), has_target.double().numpy()
        )
    return Outcome(metrics, len(scenes), int((~has_target).sum()))


def reconstruction_after_addition(model: Model, setting: Setting) -> Outcome | None:
    """Measure T3: add an absent class to each scene, and sample all objects once."""
    if model.machine is None:
        return None
    machine, scenes = model.machine, setting.some()
    added = draw_intruders(scenes, setting.structure, seed=setting.seed)
    is_altered = (added >= 0).double().numpy()
    if not is_altered.any():
        return None
    V = scenes.v.shape[1]
    errors, switched_off, still_on, present = (np.zeros(len(scenes)) for _ in range(4))
    for index, batch, generator in _blocks(scenes, setting.seed):
        intruder = added[index].clamp(min=0).unsqueeze(1)
        h1 = _draw_h1(machine, Evidence(batch.v.scatter(1, intruder, 1.0)), generator)
        v = bernoulli(machine.object_logits(h1).sigmoid(), generator)
        weight = is_altered[index]
        errors[index] = (v - batch.v).abs().sum(1).double().numpy() * weight
        switched_off[index] = (1 - v.gather(1, intruder).squeeze(1)).double().numpy() * weight
        still_on[index] = (v * batch.v).sum(1).double().numpy() * weight
        present[index] = batch.v.sum(1).double().numpy() * weight
    metrics: dict[str, Metric] = {
        "error measure": Ratio(errors, is_altered * V),
        "error measure, doing nothing": Ratio(is_altered, is_altered * V),
        "added objects switched off": Ratio(switched_off, is_altered),
        "objects of the scene kept on": Ratio(still_on, present),
    }
    return Outcome(metrics, len(scenes), int((is_altered == 0).sum()))


@torch.no_grad()
def draw_relations(
    machine: BoltzmannMachine, batch: Batch, generator: torch.Generator
) -> tuple[Tensor, Tensor]:
    """Sample all relations once, given the objects.

    Returns:
        The number of relation units that are on (scenes,), and the sampled relations between
        present classes (scenes, relations, classes, classes). Machines without gates also switch on
        relations of absent objects. Only the number of units includes these relations.
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
    """Return the probability (scenes,) that the removed class i of each scene is switched on.

    The probability is p(v_i = 1 | h1, relations), with one sample of the hidden layer h1.

    The relations of the removed class, `target` (scenes,), are unobserved without `left_on`.
    """
    column = target.unsqueeze(1)
    absent, present = batch.v.scatter(1, column, 0.0), batch.v.scatter(1, column, 1.0)
    edges, r, observed = relation_units(machine, batch)
    if not left_on:
        touched = _contains_class(edges, target)
        r, observed = r * ~touched, observed & ~touched
    h1 = _draw_h1(machine, Evidence(absent, edges, r, observed), generator)
    logit = machine.object_logits(h1).gather(1, column).squeeze(1)
    for v, sign in ((present, 1.0), (absent, -1.0)):
        logits, gate = machine.relation_logits(edges, v, h1), machine.gate(edges, v)
        logit = logit + sign * machine.relation_term(logits, gate, r, observed).sum(-1)
    # The gate of a relation is closed if one of its objects is absent. So a relation that is on
    # forces object i on.
    is_forced = (observed * r > machine.gate(edges, absent)).any(-1)
    return torch.where(is_forced, torch.inf, logit).sigmoid()


def _draw_h1(machine: BoltzmannMachine, evidence: Evidence, generator: torch.Generator) -> Tensor:
    with torch.no_grad():
        return bernoulli(mean_field(machine, evidence).y.sigmoid(), generator)


def _contains_class(edges: Edges, target: Tensor) -> Tensor:
    """Return a mask (scenes, units) of the relation units that contain the class `target`."""
    i = target.unsqueeze(1)
    return ((edges.subject == i) | (edges.object == i)) & edges.valid


def _targets(scenes: SceneTensors, structure: Tensor, seed: int) -> Tensor:
    """Draw a class to remove from each scene, (scenes,); -1 with fewer than two plain classes."""
    targets = torch.full((len(scenes),), -1, dtype=torch.int64)
    is_thing = ~structure.numpy()
    for k, scene in enumerate(scenes.scenes):
        removable = scene.evidence.classes[is_thing[scene.evidence.classes]]
        if len(removable) >= 2:
            targets[k] = int(scene_rng(scene, seed).choice(removable))
    return targets


def _blocks(scenes: SceneTensors, seed: int) -> Iterator[tuple[Tensor, Batch, torch.Generator]]:
    """Iterate over blocks of scenes: yield (scene indices, batch, random generator)."""
    generator = torch.Generator().manual_seed(seed)
    for index in torch.arange(len(scenes)).split(_BLOCK):
        yield index, scenes.batch(index), generator


SEED_TASKS: dict[str, Task] = {
    "Seed T1": Task(
        "relations, seed protocol",
        relations_switched_on,
        shown=(
            "labelled relations switched on",
            "relations switched on per scene",
            "labelled relations per scene",
        ),
    ),
    "Seed T2": Task(
        "missing object, seed protocol",
        removed_switched_on,
        shown=(
            "removed objects switched on, relations left on",
            "removed objects switched on, relations deleted",
        ),
    ),
    "Seed T3": Task(
        "intruder, seed protocol",
        reconstruction_after_addition,
        shown=("error measure", "error measure, doing nothing"),
    ),
}
"""Tasks of the seed protocol (Bozcan et al., 2018). Their results have separate tables."""
