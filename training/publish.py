"""From a finished run to a version in the store: calibrate, evaluate, describe, publish."""

from __future__ import annotations

import importlib.metadata
import json
from collections.abc import Callable
from datetime import UTC, datetime
from typing import Any

from app.registry import (
    Artifact,
    DataSource,
    Description,
    Metric,
    Store,
    VocabularyEntry,
)
from training.calibrate import calibrate
from training.draft import as_stored, draft_artifact
from training.evaluation.report import Row, evaluate
from training.pipeline import SplitScenes
from training.runs import FinishedRun
from training.terms import TERMS

_LIBRARIES = ("numpy", "scikit-learn", "scipy", "torch")


def publish_run(
    run: FinishedRun,
    scenes: SplitScenes,
    store: Store,
    version: str,
    *,
    alias: str | None = None,
    progress: Callable[[str], None] = lambda _: None,
) -> Artifact:
    """Calibrate on validation scenes, evaluate on test scenes, and publish.

    Weights are stored in half precision; they are calibrated and evaluated as they are stored.

    Raises:
        StoreError, ArtifactError: see `Store.publish`.
    """
    data = scenes.training_data()
    machine = as_stored(run.machine)
    progress("calibrating")
    relations = machine.spec.A
    draft = draft_artifact(machine, scenes.vocabulary)
    calibration = calibrate(draft, data.validation, run.config.training.seed)
    calibrated = draft_artifact(machine, scenes.vocabulary, calibration)
    rows = evaluate(calibrated, data.test, data.structure, data.train, progress=progress)
    progress("publishing")
    description = Description(
        name=run.config.name,
        version=version,
        created=datetime.now(UTC).replace(microsecond=0),
        spec=machine.spec.to_dict(),
        vocabulary=VocabularyEntry.of(scenes.vocabulary, relations),
        calibration=calibration,
        training=_training(run),
        data=data_sources(scenes),
        metrics=metrics(rows),
        terms=terms(scenes),
        libraries={name: importlib.metadata.version(name) for name in _LIBRARIES},
    )
    return store.publish(description, machine.state_dict(), storage_dtype="float16", alias=alias)


def _training(run: FinishedRun) -> dict[str, Any]:
    return {
        "config": json.loads(run.config.model_dump_json()),
        "best_epoch": run.best_epoch,
        "epochs": run.epochs,
        "parameters": run.machine.parameter_count,
    }


def data_sources(scenes: SplitScenes) -> tuple[DataSource, ...]:
    """What the model was trained on, with digests and terms."""
    return tuple(
        DataSource(
            source=source,
            scenes=scenes.counts[source],
            digest=scenes.digests[source],
            terms=TERMS[source].words,
            research_only=TERMS[source].research_only,
        )
        for source in scenes.counts
    )


def metrics(rows: list[Row]) -> tuple[Metric, ...]:
    """The evaluation's rows as the manifest keeps them."""
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


def terms(scenes: SplitScenes) -> str:
    """One sentence on what the weights may be used for."""
    research = [source for source in scenes.counts if TERMS[source].research_only]
    if research:
        return f"Research use only: trained on {', '.join(research)}. Not for commercial robots."
    return "No restriction from the training data beyond its attribution."
