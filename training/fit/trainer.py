"""Train a machine in two phases: the object weights, and then the relation weights.

`training.fit.objects` and `training.fit.relations` define the losses. Two runs with the same seed
and one thread give bit-identical weights, even if a run is interrupted and resumed.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from dataclasses import asdict
from functools import partial
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from app.inference.variants import VARIANTS
from training.datasets.batches import SceneTensors, TrainingData, seen_triples
from training.fit.checkpoint import (
    CurvePoint,
    TrainingResult,
    load_checkpoint,
    save_checkpoint,
    write_csv,
    write_plot,
)
from training.fit.configuration import Config
from training.fit.objects import ObjectFit, ObjectScenes, start_objects
from training.fit.relations import SHARED_COLUMNS, SHARED_ROWS, RelationFit
from training.fit.samples import fit_scene_rates, store_samples
from training.fit.sharing import bake_shared_weights, share_weights
from training.fit.validation import object_score, relation_score
from training.machines import BoltzmannMachine, MachineSpec, build
from training.machines.edges import find_triples, triple_keys
from training.machines.machine import OBJECT_WEIGHTS

_STEPS = 100  # steps of the first phase between two checkpoints

Progress = Callable[[str, float, float], None]
"""Function that is called with the phase, its finished share, and its mean loss."""

Passed = Callable[[CurvePoint], None]
"""Function that is called with each new point of the curve."""


def new_machine(config: Config, data: TrainingData, scenes: ObjectScenes) -> BoltzmannMachine:
    """Return a machine with small random matrices and log-odds of training counts as biases."""
    shape = config.machine
    V = data.train.v.shape[1]
    triples = seen_triples(data.train.scenes, V, shape.min_triple_count)
    spec = MachineSpec(
        shape.variant, V=V, A=data.relations, units=shape.units, states=shape.states, H2=shape.H2,
        C=data.room_types, K=shape.K if VARIANTS[shape.variant].factorised else 0, T=len(triples),
        G=shape.G, N=shape.N, profiles=len(scenes.sources), coupled=shape.coupled,
    )  # fmt: skip
    generator = torch.Generator().manual_seed(config.training.seed)
    machine = build(spec).set_triples(triples).initialise(generator, shape.initial_scale)
    start_objects(machine, scenes)
    _start_relations(machine, data.train)
    with torch.no_grad():
        for name in shape.without:
            machine.get_parameter(name).zero_().requires_grad_(False)
    return machine


def _start_relations(machine: BoltzmannMachine, scenes: SceneTensors) -> None:
    """Set the relation biases to the log-odds of relations in scenes with annotated relations."""
    A, V, T = machine.spec.A, machine.spec.V, machine.spec.T
    holding, observed, per_unit = torch.zeros(A), torch.zeros(A), torch.zeros(T)
    logs, times, annotated = torch.zeros(V), torch.zeros(V), 0
    for scene in scenes.scenes:
        evidence = scene.evidence
        if not evidence.observed.any():
            continue
        annotated += 1
        holding += torch.from_numpy(evidence.holds.sum((1, 2)))
        observed += torch.from_numpy(evidence.observed.sum((1, 2)))
        classes = torch.from_numpy(evidence.classes)
        relation, subject, object_ = torch.from_numpy(evidence.holds).nonzero(as_tuple=True)
        keys = triple_keys(relation, classes[subject], classes[object_], V)
        index, exists = find_triples(machine.triple_keys, keys)
        per_unit[index[exists]] += 1
        logs[classes] += torch.from_numpy(evidence.counts).log()
        times[classes] += 1
    machine.start_relations(
        _log_odds(holding, observed),
        _log_odds(per_unit, torch.full_like(per_unit, annotated)),
        logs / times.clamp(min=1),
    )


def _log_odds(count: Tensor, total: Tensor) -> Tensor:
    """Return the log-odds of `count` events in `total` trials, with 1/2 added to both counts."""
    return ((count + 0.5) / (total - count + 0.5)).log()


class Trainer:
    """Train one configuration on one set of scenes.

    The trainer writes `checkpoint.pt`, `curve.csv` and `curve.png` into the folder, if any.

    Raises:
        ValueError: no training scene has two classes.
    """

    def __init__(self, config: Config, data: TrainingData, folder: Path | None = None) -> None:
        self.config, self.data, self.folder = config, data, folder
        torch.set_num_threads(config.training.threads)
        self.scenes = ObjectScenes.of(data.train, data.structure, config.objects)
        self.machine = new_machine(config, data, self.scenes)
        self._share()
        self.objects = ObjectFit(self.machine, self.scenes, config.objects, config.training.seed)
        self.curve: list[CurvePoint] = []
        self.seconds = 0.0
        self._relations: RelationFit | None = None

    def _share(self) -> None:
        """Let classes share weights with their parents and with similar words."""
        data, V = self.data, self.machine.spec.V
        words = torch.zeros(V, 0) if data.words is None else data.words
        parents = data.parents
        objects, relations = self.config.objects, self.config.relations
        share_weights(self.machine, words * objects.word_weight, parents, ["W"])
        words = words * relations.word_weight
        share_weights(self.machine, words, parents, SHARED_ROWS, SHARED_COLUMNS)

    def resume(self) -> bool:
        """Load the checkpoint in the folder of the run. Return False if there is no checkpoint.

        Raises:
            RunError: the checkpoint cannot be read or belongs to another configuration.
        """
        if self.folder is None:
            return False
        state = load_checkpoint(self.folder / "checkpoint.pt", self._digest)
        if state is None:
            return False
        self.curve = [CurvePoint(**row) for row in state["curve"]]
        self.seconds = state["seconds"]
        if state["relations"] is None:
            self.machine.load_state_dict(state["machine"])
            self.objects.load_state(state["objects"])
        else:
            self.objects.steps = self.config.objects.steps
            self._begin_relations()
            self.machine.load_state_dict(state["machine"])
            self._relation_fit.load_state(state["relations"])
        return True

    @property
    def position(self) -> str:
        """The last checkpoint in words, such as "50% of the objects"."""
        if not self.curve:
            return "0% of the objects"
        return f"{self.curve[-1].done:.0%} of the {self.curve[-1].phase}"

    def run(
        self, progress: Progress = lambda *_: None, passed: Passed = lambda _: None
    ) -> TrainingResult:
        """Run both phases from the state of the trainer.

        After a KeyboardInterrupt, the last checkpoint is on disk.

        Raises:
            FloatingPointError: the training diverged.
        """
        for point in self._points(progress):
            self._save([*self.curve, point], self.seconds + point.seconds)
            self.curve.append(point)
            self.seconds += point.seconds
            passed(point)
        began = time.perf_counter()
        machine = self._relation_fit.finish(self.data.parents)
        fit_scene_rates(machine, self.scenes, self.config.objects, self.config.training.seed)
        store_samples(machine, self.scenes, self.config.training.seed)
        self.seconds += time.perf_counter() - began
        if self.folder is not None:
            write_plot(self.folder / "curve.png", self.curve, self.config.name)
        return TrainingResult(machine, self.curve, self.seconds)

    def _points(self, progress: Progress) -> Iterator[CurvePoint]:
        """Run the rest of both phases. Yield a point of the curve at each checkpoint."""
        while not self.objects.finished:
            yield self._train_objects(progress)
        if self._relations is None:
            self._begin_relations()
        while not self._relation_fit.finished:
            yield self._train_relations(progress)

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
        if fit.finished:
            self._begin_relations()
        seconds = time.perf_counter() - began
        return CurvePoint("objects", fit.steps / total, float(np.mean(losses)), score, seconds)

    def _train_relations(self, progress: Progress) -> CurvePoint:
        """Run the next epoch of the second phase."""
        fit, began = self._relation_fit, time.perf_counter()
        loss = fit.epoch(partial(progress, "relations"))
        with fit.averaged():
            score = relation_score(self.machine, self.data)
        return CurvePoint("relations", fit.done, loss, score, time.perf_counter() - began)

    def _begin_relations(self) -> None:
        """Fix the object weights, and start the second phase."""
        with torch.no_grad():
            bake_shared_weights(self.machine, ["W"])
            silence(self.machine, self.data.structure)
        for name in OBJECT_WEIGHTS:
            if name in dict(self.machine.named_parameters()):
                self.machine.get_parameter(name).requires_grad_(False)
        config = self.config
        seed = config.training.seed
        self._relations = RelationFit(self.machine, self.data.train, config.relations, seed)

    @property
    def _relation_fit(self) -> RelationFit:
        if self._relations is None:
            raise RuntimeError("the second phase has not begun")
        return self._relations

    @property
    def _digest(self) -> str:
        return f"{self.config.digest} {self.data.digest}"

    def _save(self, curve: list[CurvePoint], seconds: float) -> None:
        """Write the checkpoint and the curve."""
        if self.folder is None:
            return
        relations = self._relations
        save_checkpoint(
            self.folder / "checkpoint.pt",
            {
                "digest": self._digest,
                "machine": self.machine.state_dict(),
                "objects": None if relations else self.objects.state(),
                "relations": relations.state() if relations else None,
                "curve": [asdict(point) for point in curve],
                "seconds": seconds,
            },
        )
        write_csv(self.folder / "curve.csv", curve)


def silence(machine: BoltzmannMachine, structure: Tensor) -> None:
    """Set the object weights of structure classes to 0, so that listing them changes nothing."""
    for name in ("W", "L"):
        if name in dict(machine.named_parameters()):
            machine.get_parameter(name)[structure] = 0
    if machine.spec.coupled:
        machine.L[:, structure] = 0
        machine.Y[:, structure] = 0
