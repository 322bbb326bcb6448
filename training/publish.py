"""Publish a finished run as a version in the store: calibrate, evaluate, describe, publish."""

from __future__ import annotations

import importlib.metadata
import json
from collections.abc import Callable
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import torch

from app.inference.posterior import ClosedForm
from app.registry import (
    Artifact,
    Calibration,
    DataSource,
    Description,
    Metric,
    Offsets,
    Store,
    VocabularyEntry,
)
from app.scene import Vocabulary
from training.calibrate import calibrate
from training.config import DataConfig
from training.datasets.sources import SOURCES
from training.evaluation.everyday import EVERYDAY
from training.evaluation.report import Row, evaluate
from training.machines import BoltzmannMachine
from training.machines.arrays import weights_of
from training.offsets import fit_offsets
from training.oracle.drawn import DrawnPosterior
from training.pipeline import SplitScenes
from training.runs import FinishedRun
from training.trainer import TrainingData

_LIBRARIES = ("numpy", "scikit-learn", "scipy", "torch")


def publish_run(
    run: FinishedRun,
    scenes: SplitScenes,
    store: Store,
    version: str,
    *,
    alias: str | None = None,
    measured: tuple[FinishedRun, SplitScenes] | None = None,
    judge: Callable[[Artifact], None] | None = None,
    progress: Callable[[str], None] = lambda _: None,
) -> Artifact:
    """Calibrate on validation scenes, fit offsets to training scenes, evaluate, and publish.

    Weights are stored in half precision. Calibration and evaluation use the stored precision.

    Args:
        measured: a run of the same configuration that did not use test scenes, and its scenes. The
            test results and chosen values of this run are published, because the weights of `run`
            are trained on all scenes.
        judge: called with the calibrated model; an exception from it stops the publication.

    Raises:
        RunError: the run was trained on other scenes.
        StoreError, ArtifactError: see `Store.publish`.
    """
    run.require(scenes.digest)
    data = scenes.training_data()
    machine = as_stored(run.machine)
    progress("calibrating")
    relations = machine.spec.A
    offsets = fit_offsets(scenes.parts["train"], len(scenes.vocabulary))
    if measured is None:
        calibrated = calibrated_draft(run, scenes.vocabulary, data, offsets)
        asked, test = calibrated, data
    else:
        other, kept_back = measured
        other.require(kept_back.digest)
        test = kept_back.training_data()
        asked = calibrated_draft(other, kept_back.vocabulary, test)
        calibrated = calibrated_draft(run, scenes.vocabulary, data, offsets, asked.calibration)
    calibration = calibrated.calibration
    if judge is not None:
        judge(calibrated)
    rows = _measure(asked, test, progress)
    progress("publishing")
    description = Description(
        name=run.config.name,
        version=version,
        created=datetime.now(UTC).replace(microsecond=0),
        spec=machine.spec.to_dict(),
        vocabulary=VocabularyEntry.of(scenes.vocabulary, relations),
        calibration=calibration,
        training=_training(run, measured),
        data=data_sources(scenes),
        metrics=metrics(rows),
        terms=terms(scenes),
        libraries={name: importlib.metadata.version(name) for name in _LIBRARIES},
    )
    tensors = {} if offsets is None else offsets.tensors()
    state = machine.state_dict() | tensors
    return store.publish(description, state, storage_dtype="float16", alias=alias)


def calibrated_draft(
    run: FinishedRun,
    vocabulary: Vocabulary,
    data: TrainingData,
    offsets: Offsets | None = None,
    chosen: Calibration | None = None,
) -> Artifact:
    """Return the calibrated artifact of a run, with weights rounded to the stored precision.

    Args:
        chosen: see `calibrate_objects`.
    """
    machine = as_stored(run.machine)
    calibration = calibrate(
        draft_artifact(machine, vocabulary),
        data.validation,
        data.train,
        run.config.training.seed,
        chosen,
    )
    return draft_artifact(machine, vocabulary, calibration, offsets)


@torch.no_grad()
def as_stored(machine: BoltzmannMachine) -> BoltzmannMachine:
    """Round the matrices of the machine to half precision in place, as the store keeps them."""
    for parameter in machine.parameters():
        if parameter.dim() > 1:
            parameter.copy_(parameter.half().float())
    return machine.requires_grad_(False).eval()


def draft_artifact(
    machine: BoltzmannMachine,
    vocabulary: Vocabulary,
    calibration: Calibration | None = None,
    offsets: Offsets | None = None,
) -> Artifact:
    """Return an artifact that exists in memory only; its default calibration is neutral."""
    return Artifact(
        manifest=None,  # type: ignore[arg-type]  # questions never read it
        weights=weights_of(machine),
        vocabulary=vocabulary,
        calibration=calibration or Calibration.neutral(machine.spec.A),
        digest="",
        card="",
        path=Path(),
        offsets=offsets,
        oracle=None if ClosedForm.fits(weights_of(machine)) else DrawnPosterior,
    )


def _measure(artifact: Artifact, data: TrainingData, progress: Callable[[str], None]) -> list[Row]:
    """Return the metrics on the test part; an empty list without test scenes."""
    if not len(data.test):
        return []
    return evaluate(
        artifact, data.test, data.structure, data.train, everyday=EVERYDAY, progress=progress
    )


def _training(run: FinishedRun, measured: tuple[FinishedRun, SplitScenes] | None) -> dict[str, Any]:
    kept = {} if measured is None else {"measured_split": measured[0].config.data.split}
    return kept | {
        "config": json.loads(run.config.model_dump_json()),
        "best_epoch": run.best_epoch,
        "epochs": run.epochs,
        "parameters": run.machine.parameter_count,
    }


def data_sources(scenes: SplitScenes) -> tuple[DataSource, ...]:
    """Return the sources of the training data, with digests and terms."""
    sources = []
    for source, count in scenes.counts.items():
        words, research_only = terms_of(source, scenes.data)
        sources.append(
            DataSource(
                source=source,
                scenes=count,
                digest=scenes.digests[source],
                terms=words,
                research_only=research_only,
            )
        )
    return tuple(sources)


def metrics(rows: list[Row]) -> tuple[Metric, ...]:
    """Convert the rows of the evaluation to the metrics of the manifest."""
    return tuple(
        Metric(
            task=row.task,
            source=row.source,
            metric=row.metric,
            value=row.figure.value,
            low=row.figure.low,
            high=row.figure.high,
            n=row.figure.n,
        )
        for row in rows
    )


def terms_of(source: str, data: DataConfig) -> tuple[str, bool]:
    """Return the terms of use of a source as text, and whether they allow research only.

    The terms of the user's own files come from the configuration.
    """
    if source in SOURCES and source in data.sources:
        return SOURCES[source].terms, SOURCES[source].research_only
    words = data.terms or "the user's own scenes, without stated terms of use"
    return words, data.research_only


def terms(scenes: SplitScenes) -> str:
    """Return a sentence about the allowed use of the weights."""
    every = {source: terms_of(source, scenes.data) for source in scenes.counts}
    if research := [source for source, (_, research_only) in every.items() if research_only]:
        return f"Research use only: trained on {', '.join(research)}. Not for commercial robots."
    if own := {source: words for source, (words, _) in every.items() if source not in SOURCES}:
        return " ".join(
            f"Trained on {source}: {words.rstrip('.')}." for source, words in own.items()
        )
    return "No restriction from the training data beyond its attribution."
