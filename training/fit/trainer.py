"""Train a machine in two phases. Equal seeds and one thread give bit-identical weights."""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Final

import numpy as np
import torch
from torch import Tensor

from app.inference.variants import VARIANTS
from app.scene import CANONICAL
from training.datasets.batches import TrainingData, seen_triples, subset
from training.evaluation.asking import score_relations
from training.evaluation.parts import validation_score
from training.evaluation.relation_tasks import r_precision, score_scenes
from training.fit.configuration import Config
from training.fit.draft import draft_artifact
from training.fit.long_chains import fit_scene_rates, store_samples
from training.fit.objects import ObjectFit, ObjectScenes, start_objects
from training.fit.relation_weights import SHARED, RelationFit, bake_shared_weights, share_weights
from training.machines import BoltzmannMachine, MachineSpec, build
from training.machines.edges import find_triples, triple_keys
from training.machines.machine import OBJECT_WEIGHTS

_STEPS = 100  # steps of the first phase between two points of the curve
_SCORED = 200  # minimum number of scenes with relations of a validation score

SCORES: Final = {"objects": "MRR", "relations": "R-precision"}
"""Name of the validation score of each phase."""


@dataclass(frozen=True)
class CurvePoint:
    """One point of the training curve."""

    phase: str  # "objects" or "relations"
    done: float  # finished share of the phase, from 0 to 1
    loss: float  # mean since the previous point of the phase
    score: float  # on validation scenes; NaN means that no scene can be scored
    seconds: float  # since the previous point


@dataclass(frozen=True)
class TrainingResult:
    """The trained machine, the training curve and the duration in seconds."""

    machine: BoltzmannMachine
    curve: list[CurvePoint]
    seconds: float


Progress = Callable[[str, float, float], None]
"""Function that is called with the phase, its finished share, and its mean loss."""

Passed = Callable[[CurvePoint], None]  # function that is called with each new point of the curve


def new_machine(config: Config, data: TrainingData, scenes: ObjectScenes) -> BoltzmannMachine:
    """Return a machine with small random matrices and log-odds of training counts as biases."""
    shape = config.machine
    V = data.train.v.shape[1]
    triples = seen_triples(data.train.scenes, V, shape.min_triple_count)
    spec = MachineSpec(
        shape.variant, V=V, A=len(CANONICAL), units=shape.units, states=shape.states,
        C=len(data.vocabulary.room_types), T=len(triples), G=shape.G, N=shape.N,
        K=shape.K if VARIANTS[shape.variant].factorised else 0,
        profiles=len(scenes.sources), coupled=shape.coupled,
    )  # fmt: skip
    generator = torch.Generator().manual_seed(config.training.seed)
    machine = build(spec).set_triples(triples).initialise(generator, shape.initial_scale)
    start_objects(machine, scenes)
    _start_relations(machine, data)
    with torch.no_grad():
        for name in shape.without:
            machine.get_parameter(name).zero_().requires_grad_(False)
    return machine


def _start_relations(machine: BoltzmannMachine, data: TrainingData) -> None:
    """Set the relation biases to the log-odds of relations in scenes with annotated relations."""
    A, V, T = machine.spec.A, machine.spec.V, machine.spec.T
    holding, observed, per_unit = torch.zeros(A), torch.zeros(A), torch.zeros(T)
    log_counts, class_scenes = torch.zeros(V), torch.zeros(V)
    all_evidence = [scene.evidence for scene in data.train.scenes]
    annotated = [evidence for evidence in all_evidence if evidence.observed.any()]
    for evidence in annotated:
        holding += torch.from_numpy(evidence.holds.sum((1, 2)))
        observed += torch.from_numpy(evidence.observed.sum((1, 2)))
        classes = torch.from_numpy(evidence.classes)
        relation, subject, object_ = torch.from_numpy(evidence.holds).nonzero(as_tuple=True)
        keys = triple_keys(relation, classes[subject], classes[object_], V)
        index, exists = find_triples(machine.triple_keys, keys)
        per_unit[index[exists]] += 1
        log_counts[classes] += torch.from_numpy(evidence.counts).log()
        class_scenes[classes] += 1

    def log_odds(count: Tensor, total: Tensor | int) -> Tensor:
        return ((count + 0.5) / (total - count + 0.5)).log()

    machine.start_relations(
        by_relation=log_odds(holding, observed),
        by_unit=log_odds(per_unit, len(annotated)),
        mean_log_counts=log_counts / class_scenes.clamp(min=1),
    )


class Trainer:
    """Train one configuration on one set of scenes. `curve` has the points so far."""

    def __init__(self, config: Config, data: TrainingData) -> None:
        """Build the machine, and prepare the phase `objects`."""
        self.config, self.data = config, data
        torch.set_num_threads(config.training.threads)
        self.scenes = ObjectScenes.of(data.train, data.structure, config.objects)
        self.machine = new_machine(config, data, self.scenes)
        words = torch.zeros(self.machine.spec.V, 0) if data.words is None else data.words
        for section, names in ((config.objects, ("W",)), (config.relations, SHARED)):
            share_weights(self.machine, words * section.word_weight, data.parents, names)
        self.objects = ObjectFit(self.machine, self.scenes, config.objects, config.training.seed)
        self.curve: list[CurvePoint] = []

    def run(
        self, progress: Progress = lambda *_: None, passed: Passed = lambda _: None
    ) -> TrainingResult:
        """Train the remaining steps of both phases, and then what only Gibbs chains use."""
        began, seed = time.perf_counter(), self.config.training.seed

        def add(point: CurvePoint) -> None:
            self.curve.append(point)
            passed(point)

        while not self.objects.finished:
            add(self._train_objects(progress))
        relations = self._begin_relations()
        while not relations.finished:
            add(self._train_relations(relations, progress))
        machine = relations.finish(self.data.parents)
        # The samples come last, because their chains use the fitted weights u.
        fit_scene_rates(machine, self.scenes, self.config.objects, seed)
        store_samples(machine, self.scenes, seed)
        return TrainingResult(machine, self.curve, time.perf_counter() - began)

    def _train_objects(self, progress: Progress) -> CurvePoint:
        """Run the next steps of the first phase."""
        fit, began = self.objects, time.perf_counter()
        total, losses = fit.config.steps, []
        for _ in range(min(_STEPS, total - fit.steps)):
            fit.step()
            losses.append(fit.loss)
            progress("objects", fit.steps / total, float(np.mean(losses)))
        if fit.finished:
            fit.finish()
        score = object_score(self.machine, self.data)
        seconds = time.perf_counter() - began
        return CurvePoint("objects", fit.steps / total, float(np.mean(losses)), score, seconds)

    def _train_relations(self, fit: RelationFit, progress: Progress) -> CurvePoint:
        """Run the next epoch of the second phase."""
        began = time.perf_counter()
        loss = fit.epoch(partial(progress, "relations"))
        with fit.averaged():
            score = relation_score(self.machine, self.data)
        done, seconds = fit.epochs / fit.config.epochs, time.perf_counter() - began
        return CurvePoint("relations", done, loss, score, seconds)

    @torch.no_grad()
    def _begin_relations(self) -> RelationFit:
        """Fix the object weights, those of structure at 0, and start the second phase."""
        machine, structure = self.machine, self.data.structure
        bake_shared_weights(machine, ["W"])
        machine.W[structure] = 0
        if machine.spec.coupled:
            machine.L[structure] = machine.L[:, structure] = machine.Y[:, structure] = 0
        for name, weight in machine.named_parameters():
            if name in OBJECT_WEIGHTS:
                weight.requires_grad_(False)
        config, seed = self.config.relations, self.config.training.seed
        return RelationFit(machine, self.data.train, config, seed)


@torch.no_grad()
def object_score(machine: BoltzmannMachine, data: TrainingData) -> float:
    """Return the MRR of hidden classes in random parts of real scenes; NaN without such scenes."""

    def log_odds(listed: Tensor, share: Tensor) -> Tensor:
        return machine.object_log_odds(listed * ~data.structure, share=share)

    return validation_score(log_odds, data.validation, data.structure)


@torch.no_grad()
def relation_score(machine: BoltzmannMachine, data: TrainingData) -> float:
    """Return the R-precision of relations given the objects; NaN without annotated scenes."""
    annotated = [k for k, s in enumerate(data.validation.scenes) if s.evidence.holds.any()]
    if not annotated:
        return math.nan
    chosen = annotated[:: max(1, len(annotated) // _SCORED)]
    score = partial(score_relations, draft_artifact(machine, data.vocabulary), given=False)
    scenes = subset(data.validation, torch.tensor(chosen))
    precision = r_precision(score_scenes(scenes, data.structure, score), len(scenes))
    return 0.0 if precision is None else precision.value
