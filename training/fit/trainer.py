"""The trainer of every machine and objective: updates, early stopping, checkpoints, curves.

With one thread, two runs with the same seed give bit-identical weights, even if a run is
interrupted and resumed after an epoch. `machines.distributed` splits the batches between processes.
"""

from __future__ import annotations

import copy
import math
import time
from collections.abc import Callable
from contextlib import nullcontext
from dataclasses import asdict
from functools import partial
from pathlib import Path

import torch
from torch import Tensor, nn

from app.inference.variants import VARIANTS
from training.datasets.batches import Batch, SceneTensors, TrainingData, seen_triples, subset
from training.evaluation.parts import validation_score
from training.evaluation.relation_tasks import rank_relations
from training.fit.checkpoint import (
    Epoch,
    TrainingResult,
    load_checkpoint,
    save_checkpoint,
    write_csv,
    write_plot,
)
from training.fit.configuration import Config
from training.fit.machine_scores import MachineScore, relation_score
from training.fit.object_weights import OBJECT_WEIGHTS, fine_tune, fit_objects, store_samples
from training.fit.objectives import OBJECTIVES, Objective
from training.fit.reconstruction import reconstruction_error
from training.machines import BoltzmannMachine, MachineSpec, build, distributed
from training.machines.bernoulli import log_odds_of
from training.machines.edges import find_triples, triple_keys

_VALIDATION_SCENES = 400
_DRAWN_EVERY = 20.0  # s
# Attributes of the trainer that a checkpoint stores as they are.
_COUNTERS = ("objects_trained", "best_epoch", "best_score", "updates", "seconds")
# Function that is called in the first training phase (objects only) with its finished share.
ObjectProgress = Callable[[float], None]
# Names of the weights with the full learning rate. The setting `relation_rate` can lower the rate
# of all other weights. Relation weights can overfit within one epoch.
_FULL_RATE = frozenset({"b", "c1", "c2", "W", "J", "Q", "gamma", "B"})

# Function that is called after every update with the epoch, its finished share and its mean loss.
Progress = Callable[[int, float, float], None]
Ended = Callable[[Epoch], None]  # is called after every epoch


def new_machine(config: Config, data: TrainingData, generator: torch.Generator) -> BoltzmannMachine:
    """Return a machine with small random matrices and log-odds of training counts as biases."""
    shape = config.machine
    V = data.train.v.shape[1]
    triples = seen_triples(data.train.scenes, V, shape.min_triple_count)
    spec = MachineSpec(
        shape.variant, V=V, A=data.relations, H1=shape.H1, H2=shape.H2, C=data.room_types,
        K=shape.K if VARIANTS[shape.variant].factorised else 0, T=len(triples), G=shape.G,
        N=shape.N, form=shape.form,
    )  # fmt: skip
    machine = build(spec).set_triples(triples).initialise(generator, shape.initial_scale)
    with torch.no_grad():
        annotated = data.train.annotated_classes[data.train.source].sum(0)
        # If no data source annotates a class, its bias must mean a rare class. The formula alone
        # would give a probability of 1/2.
        annotated = torch.where(annotated > 0, annotated, len(data.train))
        machine.b.copy_(log_odds_of(data.train.v.sum(0), annotated))
        machine.c1.fill_(shape.initial_c1)
        machine.Q.zero_()
        _start_relations(machine, data.train)
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
        log_odds_of(holding, observed),
        log_odds_of(per_unit, torch.full_like(per_unit, annotated)),
        logs / times.clamp(min=1),
    )


class _Loss(nn.Module):
    """The loss of this process' share of a batch; the mean over processes is the global loss."""

    def __init__(self, objective: Objective, machine: BoltzmannMachine) -> None:
        super().__init__()
        self.objective, self.machine = objective, machine
        self.objective_parameters = nn.ParameterList(objective.parameters())

    def forward(self, batch: Batch, generator: torch.Generator) -> Tensor:
        """Return the loss, times the number of processes."""
        return self.objective.loss(self.machine, batch, generator) * distributed.size()


class Trainer:
    """Train one configuration on one set of scenes.

    The first process writes `checkpoint.pt`, `curve.csv` and `curve.png` into the folder, if any.
    """

    def __init__(self, config: Config, data: TrainingData, folder: Path | None = None) -> None:
        self.config, self.data, self.folder = config, data, folder
        torch.set_num_threads(config.training.threads)
        self.device = distributed.device_of(config.training.device)
        self.generator = distributed.new_generator(config.training.seed)
        self.machine = new_machine(config, data, self.generator).to(self.device)
        self.machine.index_triples()
        kind = OBJECTIVES[config.objective.name]
        with self._on_device():
            self.objective: Objective = kind.of(config.objective, self.machine, data)
        self.train = data.train
        if config.objects.epochs:
            self.train = _select_annotated(data.train)
            for name in OBJECT_WEIGHTS:
                self.machine.get_parameter(name).requires_grad_(False)
        self.loss = distributed.parallel(_Loss(self.objective, self.machine))
        self.optimiser = self._new_optimiser()
        self.steps_per_epoch = math.ceil(len(self.train) / config.training.batch_size)
        self.scheduler = self._new_scheduler()
        self.average = self._copy_weights()
        self.updates = 0
        self.epochs: list[Epoch] = []
        self.best: dict[str, Tensor] = {}
        self.best_epoch, self.best_score = -1, -math.inf
        self.seconds = 0.0
        self.objects_trained = not config.objects.epochs
        self._plotted_at = -math.inf

    def _copy_weights(self) -> dict[str, Tensor]:
        return {name: p.detach().clone() for name, p in self.machine.named_parameters()}

    def _on_device(self) -> torch.device | nullcontext[None]:
        """Return a context in which new tensors are on the device."""
        return nullcontext() if self.device.type == "cpu" else self.device

    def _on_cpu(self) -> BoltzmannMachine:
        """Return the machine, on a GPU a copy; objects and validation use the CPU."""
        if self.device.type == "cpu":
            return self.machine
        machine = copy.deepcopy(self.machine).cpu()
        machine.index_triples()
        return machine

    def _new_optimiser(self) -> torch.optim.Optimizer:
        """Return an optimiser; biases have no decay, and weights of relations their own rate."""
        t = self.config.training
        groups: tuple[list[Tensor], list[Tensor], list[Tensor]] = ([], [], [])
        matrices, biases, relations = groups
        for name, parameter in self.machine.named_parameters():
            if not parameter.requires_grad:
                continue
            group = matrices if parameter.dim() > 1 else biases
            (group if name in _FULL_RATE else relations).append(parameter)
        biases += self.objective.parameters()
        decays = t.weight_decay, 0.0, t.relation_decay
        rates = t.learning_rate, t.learning_rate, t.learning_rate * t.relation_rate
        settings = [
            {"params": group, "weight_decay": decay, "lr": rate}
            for group, decay, rate in zip(groups, decays, rates, strict=True)
        ]
        kind = torch.optim.SGD if t.optimiser == "sgd" else torch.optim.AdamW
        return kind(settings, lr=t.learning_rate, fused=True)

    def _new_scheduler(self) -> torch.optim.lr_scheduler.LambdaLR:
        """Return the schedule of the learning rate.

        In the one-cycle schedule, it rises over the first tenth of the updates, and then falls to 0
        along a cosine.
        """
        t = self.config.training
        if t.schedule == "constant":
            return torch.optim.lr_scheduler.LambdaLR(self.optimiser, lambda _: 1.0)
        total = t.epochs * self.steps_per_epoch
        rise = max(1, total // 10)

        def factor(step: int) -> float:
            if step < rise:
                return (step + 1) / rise
            return 0.5 * (1 + math.cos(math.pi * min(1.0, (step - rise) / max(total - rise, 1))))

        return torch.optim.lr_scheduler.LambdaLR(self.optimiser, factor)

    def resume(self) -> bool:
        """Load the checkpoint in the folder of the run. Return False if there is no checkpoint.

        Raises:
            RunError: the checkpoint cannot be read or belongs to another configuration.
        """
        if self.folder is None:
            return False
        path = self.folder / "checkpoint.pt"
        state = distributed.on_first(partial(load_checkpoint, path, self._digest))
        if state is None:
            return False
        for name in ("objective", "average", "best"):
            state[name] = {key: value.to(self.device) for key, value in state[name].items()}
        self.machine.load_state_dict(state["machine"])
        self.optimiser.load_state_dict(state["optimiser"])
        self.scheduler.load_state_dict(state["scheduler"])
        self.objective.load_state(state["objective"])
        self.generator.set_state(state["generator"])
        self.average, self.best = state["average"], state["best"]
        for name in _COUNTERS:
            setattr(self, name, state[name])
        self.epochs = [Epoch(**row) for row in state["epochs"]]
        return True

    def run(
        self,
        progress: Progress | None = None,
        ended: Ended | None = None,
        objects: ObjectProgress = lambda _: None,
    ) -> TrainingResult:
        """Run the first training phase (objects only) if there is one, then all epochs.

        Training ends earlier if the validation score does not improve for `training.patience`
        epochs. After a KeyboardInterrupt, the checkpoint of the last finished epoch is on disk.
        """
        if not self.objects_trained:
            began = time.perf_counter()
            state = distributed.on_first(partial(self._fit_objects, objects))
            self.machine.load_state_dict(state)
            self.objects_trained = True
            self.average = self._copy_weights()
            self.seconds += time.perf_counter() - began
            self._save()
        while len(self.epochs) < self.config.training.epochs and not self._out_of_patience():
            self._epoch(progress)
            self._save()
            if ended is not None:
                ended(self.epochs[-1])
        self._plot()
        with torch.no_grad():
            for name, value in self.best.items():
                self.machine.get_parameter(name).copy_(value)
        self.machine.cpu().index_triples()
        machine = self.objective.finish(self.machine, self.train)
        if not self.config.objects.epochs:
            training, dropout = self.config.training, self.config.objective.room_dropout
            data = self.data.train
            fine_tune(self.machine, data, self.config.polish, dropout, training.seed)
        return TrainingResult(machine, self.epochs, self.best_epoch, self.seconds)

    def _fit_objects(self, progress: ObjectProgress) -> dict[str, Tensor]:
        machine, seed = self._on_cpu(), self.config.training.seed
        fit_objects(machine, self.data.train, self.config.objects, seed, progress)
        store_samples(machine, self.data.train, self.config.objective.room_dropout, seed)
        return machine.state_dict()

    @property
    def _digest(self) -> str:
        return f"{self.config.digest} {self.data.digest}"

    def _out_of_patience(self) -> bool:
        patience = self.config.training.patience
        return patience is not None and len(self.epochs) - 1 - self.best_epoch >= patience

    def _epoch(self, progress: Progress | None) -> None:
        began = time.perf_counter()
        number = len(self.epochs)
        total, steps = 0.0, 0
        order = torch.randperm(len(self.train), generator=self.generator)
        for index in order.split(self.config.training.batch_size):
            total, steps = total + self._update(index), steps + 1
            if progress is not None:
                progress(number, steps / self.steps_per_epoch, total / steps)
        global_total = distributed.total(torch.tensor(total, dtype=torch.float64))
        loss = float(global_total) / distributed.size() / steps
        is_finite = all(bool(p.isfinite().all()) for p in self.machine.parameters())
        if not math.isfinite(loss) or not is_finite:
            raise FloatingPointError(
                f"the training diverged in epoch {number}, with a loss of {loss}: lower the "
                "learning rate (training.learning_rate)"
            )
        self._close_epoch(number, loss, began)

    def _update(self, index: Tensor) -> float:
        """Update the weights and their average on a batch. Return the loss of this process."""
        width = max(len(self.train.scenes[k].evidence.classes) for k in index.tolist())
        batch = self.train.batch(distributed.share(index), width).to(self.device)
        with self._on_device():
            loss = self.loss(batch, self.generator)
            self.optimiser.zero_grad()
            loss.backward()
            self.objective.adjust_gradients(self.machine)
        self.optimiser.step()
        self.scheduler.step()
        self.updates += 1
        decay = self.config.training.averaging
        if decay:
            # During the first updates, a smaller decay reduces the share of the initial weights in
            # the average.
            weight = 1 - min(decay, self.updates / (self.updates + 10))
            for name, parameter in self.machine.named_parameters():
                self.average[name].lerp_(parameter.detach(), weight)
        return float(loss.detach())

    @torch.no_grad()
    def _close_epoch(self, number: int, loss: float, began: float) -> None:
        """Evaluate the weights, or their average, on validation scenes. Keep the best weights."""
        parameters, current = dict(self.machine.named_parameters()), self._copy_weights()
        if self.config.training.averaging:
            for name, p in parameters.items():
                p.copy_(self.average[name])
        machine = self._on_cpu()
        works: list[Callable[[], tuple[float, ...]]] = [
            partial(self._rank_objects, machine),
            partial(self._rank_relations, machine),
            partial(reconstruction_error, machine, self.data.train),
            partial(reconstruction_error, machine, self.data.validation),
        ]
        (mrr,), (precision,), train, validation = distributed.spread(works)
        score = mrr + (0.0 if math.isnan(precision) else precision)
        if score > self.best_score or self.objective.keeps_last:
            self.best_score, self.best_epoch = score, number
            self.best = self._copy_weights()
        for name, p in parameters.items():
            p.copy_(current[name])
        seconds = time.perf_counter() - began
        self.seconds += seconds
        errors = train[0], train[1], validation[0], validation[1]
        self.epochs.append(Epoch(number, loss, *errors, mrr, precision, seconds))

    def _rank_objects(self, machine: BoltzmannMachine) -> tuple[float]:
        """Return the validation score of objects, see `validation_score`."""
        score = MachineScore(machine)
        scenes, structure = self.data.validation, self.data.structure
        return (validation_score(lambda v, _: score(v), scenes, structure),)

    def _rank_relations(self, machine: BoltzmannMachine) -> tuple[float]:
        """Return the R-precision of relations on fixed validation scenes."""
        annotated = [
            k for k, scene in enumerate(self.data.validation.scenes) if scene.evidence.holds.any()
        ][:_VALIDATION_SCENES]
        if not annotated:
            return (math.nan,)
        sample = subset(self.data.validation, torch.tensor(annotated))
        ranking = rank_relations(sample, self.data.structure, relation_score(machine, draws=16))
        return (float(ranking.hits.sum() / max(ranking.annotated.sum(), 1)),)

    def _save(self) -> None:
        """Write the checkpoint and the curve; all processes must call, as chains are gathered."""
        if self.folder is None:
            return
        objective = self.objective.state()
        if not distributed.is_first():
            return
        save_checkpoint(
            self.folder / "checkpoint.pt",
            {
                "digest": self._digest,
                "machine": self.machine.state_dict(),
                "optimiser": self.optimiser.state_dict(),
                "scheduler": self.scheduler.state_dict(),
                "objective": objective,
                "generator": self.generator.get_state(),
                "average": self.average,
                "best": self.best,
                **{name: getattr(self, name) for name in _COUNTERS},
                "epochs": [asdict(epoch) for epoch in self.epochs],
            },
        )
        if not self.epochs:
            return
        write_csv(self.folder / "curve.csv", self.epochs)
        # Plot at most once in _DRAWN_EVERY seconds. With few scenes, a plot takes longer than an
        # epoch.
        if time.perf_counter() - self._plotted_at > _DRAWN_EVERY:
            self._plot()

    def _plot(self) -> None:
        if self.folder is not None and distributed.is_first():
            write_plot(self.folder / "curve.png", self.epochs, self.config.name)
            self._plotted_at = time.perf_counter()


def _select_annotated(scenes: SceneTensors) -> SceneTensors:
    """Return the scenes with an annotated relation, or all scenes if no scene has one."""
    annotated = [k for k, scene in enumerate(scenes.scenes) if scene.evidence.observed.any()]
    return subset(scenes, torch.tensor(annotated, dtype=torch.int64)) if annotated else scenes
