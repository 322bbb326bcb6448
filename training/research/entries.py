"""The entries of a result table: machines, baselines with tuned settings, untrained references."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np
import torch

from app.scene.spatial_relations import STACKED
from training.datasets.batches import SceneTensors, TrainingData, subset
from training.datasets.cases import some_scenes
from training.evaluation.asking import artifact_model, ask_rows
from training.evaluation.baselines import PLACED, frequency, placed_product
from training.evaluation.generation_task import held_out_scenes, independent_scenes
from training.evaluation.outlier_tasks import intruder_weights, with_intruders
from training.evaluation.pair_task import SHIFTS, baseline_log_odds, lateral_shift, listed_pairs
from training.evaluation.parts import Ranking
from training.evaluation.report import Progress, silent
from training.evaluation.selection import TRIALS, Baseline
from training.evaluation.setting import Model, ObjectScore, Structure, suspicion_of
from training.fit.calibrate import calibrate
from training.fit.configuration import Config, ObjectsConfig
from training.fit.draft import placed_draft
from training.fit.objects import ObjectScenes
from training.fit.trainer import Trainer
from training.machines import BoltzmannMachine
from training.research.baselines import BASELINES
from training.runs.folder import RunError, load_run, save_run

# Weights of log popularity in the ranking of intruders: scores of baselines have different scales.
_WEIGHTS = (0.0, *np.geomspace(0.005, 2.0, TRIALS - 1).tolist())
_SCENES = 300  # maximum scenes that choose a weight or a shift


@dataclass(frozen=True, eq=False)
class Entry:
    """One model of an experiment, with one training seed."""

    name: str
    seed: int
    identity: str  # all settings that affect the results; part of the names of reports on disk
    make: Callable[[TrainingData, Path, Progress], Model]  # train it, or read it from its folder


def baseline_entries(
    seed: int,
    names: Sequence[str] | None = None,
    *,
    related: bool = True,
    learning: ObjectsConfig | None = None,
) -> Iterator[Entry]:
    """Generate the entries of the baselines in `names`; None means all baselines.

    Deterministic baselines have an entry for seed 0 only. `related=False` leaves out relation
    baselines. `learning` are settings of the machines for objects, see `object_scenes`.

    Raises:
        ValueError: a name is not in `BASELINES`.
    """
    if unknown := sorted(set(names or ()) - set(BASELINES)):
        raise ValueError(f"unknown baselines {unknown}: choose from {list(BASELINES)}")
    config = learning or ObjectsConfig()
    decisive = config.model_dump(include={"source_weights", "open_sources"})
    for name, baseline in BASELINES.items():
        is_usable = related or not baseline.answer.of_relations
        is_selected = names is None or name in names
        if is_usable and is_selected and (baseline.stochastic or seed == 0):
            make = partial(_baseline_model, baseline, seed, config)
            yield Entry(name, seed, f"{name}, seed {seed}, {decisive}, {SHIFTS}", make)


def reference_entries() -> Iterator[Entry]:
    """Generate the untrained references for the evaluation of generated scenes."""
    makers = {"independent classes": _independent, "held-out scenes (floor)": _held_out}
    for name, make in makers.items():
        yield Entry(name, 0, name, make)


def _independent(data: TrainingData, *_: object) -> Model:
    return Model(generate=independent_scenes, parameters=data.train.v.shape[1])


def _held_out(*_: object) -> Model:
    return Model(generate=held_out_scenes)


def machine_entry(config: Config) -> Entry:
    """Return the entry of a machine, calibrated as for publication."""
    identity = f"{config.digest}, calibrated"
    return Entry(config.name, config.training.seed, identity, partial(_machine_model, config))


def _baseline_model(
    baseline: Baseline,
    seed: int,
    learning: ObjectsConfig,
    data: TrainingData,
    folder: Path,  # noqa: ARG001
    say: Progress,
) -> Model:
    """Fit a baseline; one for objects or rooms to `object_scenes`.

    An object baseline ranks intruders with a prior of popularity, as `/outliers` does. For T2-at
    (missing object at a place), its score is multiplied by a frequency table.
    """

    def fit(baseline: Baseline, data: TrainingData) -> Model:
        parts = data.train, data.validation, data.structure
        return baseline.fit(*parts, seed=seed, progress=say)

    if baseline.answer.of_relations:
        return with_lateral_shift(fit(baseline, data), data)
    objects = replace(data, train=object_scenes(data.train, data.structure, learning))
    model = fit(baseline, objects)
    if model.missing is None:
        return model
    model = replace(model, suspicion=tuned_suspicion(model.missing, objects, seed))
    if not data.related:
        return model
    product = fit(placed_product(baseline.name, model, fit(PLACED, data)), objects)
    return replace(model, at_place=product.at_place)


def with_lateral_shift(model: Model, data: TrainingData) -> Model:
    """Return a model of relations with the shift of left and front that a machine also gets."""
    if model.relations is None:
        return model
    scenes = some_scenes(data.validation, _SCENES, 0)
    log_odds = baseline_log_odds(scenes, model.relations)
    shift = lateral_shift(log_odds, listed_pairs(scenes, data.structure, STACKED))
    return replace(model, lateral=shift)


def object_scenes(train: SceneTensors, structure: Structure, config: ObjectsConfig) -> SceneTensors:
    """Return the scenes from which a machine learns objects, with its weights and masks."""
    learnt = ObjectScenes.of(train, structure, config)
    shows = torch.zeros_like(train.annotated_classes)
    shows[[train.source_names.index(name) for name in learnt.sources]] = learnt.shows
    weight_of = config.source_weights
    weighted = [
        replace(scene, weight=scene.weight * weight_of.get(scene.source, 1.0))
        for scene in train.scenes
    ]
    v = train.v * shows[train.source]
    kept = (v.sum(1) >= 2) & torch.tensor([scene.weight > 0 for scene in weighted])
    masked = replace(train, scenes=weighted, v=v, annotated_classes=shows)
    return subset(masked, kept)


def tuned_suspicion(score: ObjectScore, data: TrainingData, seed: int) -> ObjectScore:
    """Return the suspicion with the weight of popularity that finds most validation intruders."""
    scenes = some_scenes(subset(data.validation, data.validation.complete), _SCENES, seed)
    log_popularity = frequency(data.train.v, data.train.weight).logit()
    hits = dict.fromkeys(_WEIGHTS, 0.0)
    for weights in intruder_weights(scenes, data.train).values():
        cases = with_intruders(scenes, data.structure, weights)
        if len(cases.v):
            plain = ask_rows(suspicion_of(score), cases.v, block=32)
            for weight in _WEIGHTS:
                values = plain + weight * log_popularity
                first = Ranking.of(cases.scene, cases.intruder, values, len(scenes)).top(1)
                hits[weight] += first.value
    return suspicion_of(score, log_popularity, max(hits, key=lambda weight: hits[weight]))


def _machine_model(config: Config, data: TrainingData, folder: Path, say: Progress) -> Model:
    """Train or load a machine, and calibrate it. Its weights that are held at 0 do not count."""
    run, seed = folder / "run", config.training.seed
    machine = train_once(config, data, run, say)
    draft = placed_draft(machine, data)
    say("calibrating")
    artifact = replace(draft, calibration=calibrate(draft, data, config.objects, seed))
    profiles = ObjectScenes.of(data.train, data.structure, config.objects).sources
    model = artifact_model(artifact, profiles=profiles)
    zero = sum(machine.get_parameter(name).numel() for name in config.machine.without)
    return replace(model, parameters=machine.parameter_count - zero)


def train_once(
    config: Config, data: TrainingData, run: Path, say: Progress = silent
) -> BoltzmannMachine:
    """Return the machine of the finished run in a folder. Without such a run, train it."""
    with suppress(RunError):
        return load_run(run).machine

    def progress(phase: str, done: float, loss: float) -> None:
        say(f"{phase} {done:.0%}, {loss:.3f}")

    result = Trainer(config, data).run(progress)
    save_run(run, config, result)
    return result.machine
