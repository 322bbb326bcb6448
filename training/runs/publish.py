"""Publish a new model version: a finished training run, or a version with refitted statistics."""

from __future__ import annotations

import importlib.metadata
import re
from collections.abc import Callable, Collection, Sequence
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path

from app.model import Calibration, SceneModel
from app.registry import Artifact, DataSource, Description, Metric, Store, VocabularyEntry
from training.datasets.batches import TrainingData
from training.datasets.sources import SOURCES, is_inventory
from training.datasets.vocabulary import with_aliases, with_room_aliases
from training.datasets.written import with_present_names
from training.evaluation.everyday_task import EVERYDAY
from training.evaluation.outlier_tasks import untouched_alarms
from training.evaluation.report import Progress, evaluate, silent
from training.evaluation.tasks import STATISTICS
from training.fit.calibrate import calibrate
from training.fit.calibrate_objects import refitted
from training.fit.configuration import DataConfig, source_name
from training.fit.count_statistics import fit_counts
from training.fit.draft import placed_draft
from training.fit.long_chains import measure_drift
from training.fit.objects import ObjectScenes
from training.fit.offset_statistics import fit_offsets
from training.runs.config_files import load_config, shipped_configs, stored_config, with_settings
from training.runs.example_scenes import accepted_examples, read_examples
from training.runs.folder import FinishedRun, RunError
from training.runs.pipeline import SplitScenes, read_sources, split_and_encode

# Tasks with results that depend on the alarm lines, and the names of these results.
_OF_LIMITS = ("T3 outliers", "T3 alarms", "T4 rooms", "Everyday")
_ALARM = re.compile(r"^flagged, (uniform|by popularity|signature)$|^alarms, |^outliers: .*default$")
_LIBRARIES = ("numpy", "scikit-learn", "scipy", "torch")


class RefusedError(RuntimeError):
    """The new version is refused. The text gives the reasons."""

    def __init__(self, reasons: Sequence[str]) -> None:
        super().__init__("; ".join(reasons))


def publish_run(
    run: FinishedRun,
    scenes: SplitScenes,
    store: Store,
    version: str,
    *,
    measured: tuple[FinishedRun, SplitScenes] | None = None,
    judge: Callable[[SceneModel, Progress], Sequence[str]] = lambda *_: (),
    accept: Callable[[str], None] | None = None,
    progress: Progress = silent,
) -> Artifact:
    """Calibrate on validation scenes, fit statistics, evaluate on test scenes, and publish.

    If `run` was trained on test scenes, a second run of the configuration, `measured`, gives the
    test results and the chosen calibration values. `judge` returns further reasons against the
    calibrated model. `accept` gets each reason against a model that is published all the same.

    Raises:
        RefusedError: the model raises too many alarms about untouched validation scenes, long
            chains drift away from the training scenes, or there is another reason.
        RunError: the run was trained on other scenes than `scenes`.
        StoreError, ArtifactError: see `Store.publish`.
    """
    run.require(scenes.digest)
    measured_run, measured_scenes = measured or (run, scenes)
    measured_run.require(measured_scenes.digest)
    data = scenes.training_data()
    test = data if measured is None else measured_scenes.training_data()
    progress("calibrating")
    evaluated = with_statistics(calibrated_draft(measured_run, measured_scenes), measured_scenes)
    calibrated, training = evaluated, {}
    if measured is not None:
        calibrated = with_statistics(calibrated_draft(run, scenes, evaluated.calibration), scenes)
        training = {"measured_split": measured_run.config.data.split}
    alarms = untouched_alarms(calibrated, scenes.parts["validation"])
    progress("running long chains")
    learnt = ObjectScenes.of(data.train, data.structure, run.config.objects)
    drift = measure_drift(calibrated, learnt, run.config.objects)
    objections = [*(entry.objection() for entry in alarms), drift.objection()]
    reasons = [*filter(None, objections), *judge(calibrated, progress)]
    for reason in reasons:
        if accept is None:
            raise RefusedError(reasons)
        accept(reason)
    rows = _measure(evaluated, test, progress)
    rows += drift.metrics()
    progress("publishing")
    sources = data_sources(scenes, learnt)
    description = Description(
        name=run.config.name,
        version=version,
        created=_now(),
        spec=run.machine.spec.to_dict(),
        vocabulary=VocabularyEntry.of(
            with_room_aliases(scenes.vocabulary), run.machine.spec.A, learnt.sources
        ),
        calibration=calibrated.calibration,
        training=training
        | {"config": run.config.model_dump(mode="json"), "parameters": run.machine.parameter_count},
        data=sources,
        metrics=tuple(rows),
        terms=terms(sources),
        libraries={name: importlib.metadata.version(name) for name in _LIBRARIES},
        examples=scenes.examples,
    )
    return publish_rounded(store, description, calibrated)


def refit(
    artifact: Artifact, root: Path, store: Store, version: str, *, progress: Progress = silent
) -> Artifact:
    """Publish a new version of a published model with refitted statistics, without training.

    New are offsets, counts, alarm lines, limits of generated scenes, their metrics, the examples
    of the configuration, and built-in synonyms. Statistics of weights that know the test scenes
    are measured on a second split. Flagged intruders, alarms and refused rooms of such weights
    need other weights, so their metrics are left out. `root` is the folder of the scenes.

    Raises:
        RunError: the scenes in `root` are not the training scenes of the model.
        ConfigError, DatasetError: the scenes cannot be read.
        StoreError, ArtifactError: see `Store.publish`.
    """
    manifest, model = artifact.manifest, artifact.model
    config = stored_config(artifact)
    data, is_shipped = config.data, manifest.name in shipped_configs()
    named = load_config(manifest.name).examples if is_shipped else config.examples
    examples, reasons = accepted_examples(read_examples(named, root), model.vocabulary)
    for reason in reasons:
        progress(reason)
    progress("reading scenes")
    annotated = read_sources(data, root)
    scenes = split_and_encode(data, annotated, root, model.vocabulary)
    digests = {source.source: source.digest for source in manifest.data}
    if changed := sorted(name for name in scenes.digests if digests[name] != scenes.digests[name]):
        raise RunError(
            f"{root} does not contain the training scenes of {manifest.name}@{manifest.version}: "
            f"the scenes of {', '.join(changed)} have changed"
        )
    evaluated_scenes = scenes
    if split := manifest.training.get("measured_split"):
        other = with_settings(config, {"data.split": split}).data
        evaluated_scenes = split_and_encode(other, annotated, root, model.vocabulary)
    progress("fitting statistics")
    test, own = evaluated_scenes.training_data(), scenes.training_data()
    refitted_model = refitted(with_statistics(model, scenes), own, config.objects)
    evaluated = with_statistics(model, evaluated_scenes)
    rows = _measure(evaluated, test, progress, tuple(STATISTICS))
    if not split:
        rows += _measure(refitted_model, test, progress, _OF_LIMITS)
    again = {metric.task for metric in rows} | {*STATISTICS, "T4 rooms"}
    kept = [m for m in manifest.metrics if m.task not in again and not _ALARM.search(m.metric)]
    vocabulary = VocabularyEntry.of(
        with_aliases(model.vocabulary), model.spec.A, manifest.vocabulary.profiles
    )
    fields = {name: getattr(manifest, name) for name in Description.model_fields}
    fields |= {"version": version, "created": _now(), "examples": examples}
    fields |= {"metrics": (*kept, *rows), "vocabulary": vocabulary}
    description = Description(**fields | {"calibration": refitted_model.calibration})
    return publish_rounded(store, description, refitted_model)


def rename(artifact: Artifact, store: Store, version: str) -> Artifact:
    """Publish a version of a model again with today's names of its classes and room types.

    Weights, statistics and metrics stay. Scenes with the new names had no part in them.

    Raises:
        StoreError, ArtifactError: see `Store.publish`.
    """
    manifest, model = artifact.manifest, artifact.model
    vocabulary = VocabularyEntry.of(
        with_present_names(model.vocabulary), model.spec.A, manifest.vocabulary.profiles
    )
    fields = {name: getattr(manifest, name) for name in Description.model_fields}
    fields |= {"version": version, "created": _now(), "vocabulary": vocabulary}
    return publish_rounded(store, Description(**fields), model)


def with_statistics(model: SceneModel, scenes: SplitScenes) -> SceneModel:
    """Return the model with the offsets and counts of the scenes."""
    train, vocabulary = scenes.parts["train"], scenes.vocabulary
    return replace(
        model,
        offsets=fit_offsets(train, len(vocabulary)),
        counts=fit_counts([*train, *scenes.parts["validation"]], vocabulary),
    )


def publish_rounded(store: Store, description: Description, model: SceneModel) -> Artifact:
    """Publish weights and statistics in half precision."""
    state = dict(model.weights.arrays)
    for table in (model.offsets, model.counts, model.places, model.possibility):
        if table is not None:
            state |= table.tensors()
    return store.publish(description, state, storage_dtype="float16")


def _now() -> datetime:
    return datetime.now(UTC).replace(microsecond=0)


def calibrated_draft(
    run: FinishedRun, scenes: SplitScenes, chosen: Calibration | None = None
) -> SceneModel:
    """Return the calibrated model of a run in half precision. `chosen`: see `calibrate_objects`."""
    data = scenes.training_data()
    draft = placed_draft(run.machine, data)
    calibration = calibrate(draft, data, run.config.objects, run.config.training.seed, chosen)
    return replace(draft, calibration=calibration)


def _measure(
    model: SceneModel, data: TrainingData, progress: Progress, tasks: Collection[str] | None = None
) -> list[Metric]:
    """Return the metrics on test scenes, or an empty list if there are no test scenes."""
    if not len(data.test):
        return []
    scenes = data.test, data.structure, data.train
    return evaluate(model, *scenes, everyday=EVERYDAY, tasks=tasks, progress=progress)


def data_sources(scenes: SplitScenes, learnt: ObjectScenes | None = None) -> tuple[DataSource, ...]:
    """Return the data sources, with their shares of the weight in the training of objects.

    Without `learnt`, the shares are not recorded.
    """
    sources, share_of = [], {}
    if learnt is not None:
        shares = (learnt.source_sizes / learnt.size).tolist()
        share_of = dict(zip(learnt.sources, shares, strict=True))
    written = {source_name(source) for source in scenes.data.sources if is_inventory(source)}
    for name, count in scenes.counts.items():
        words, research_only = terms_of(name, scenes.data)
        digest = scenes.digests[name]
        source = DataSource(
            source=name, scenes=count, digest=digest, terms=words, research_only=research_only,
            share=None if learnt is None else round(share_of.get(name, 0.0), 4),
            written=name in written,
        )  # fmt: skip
        sources.append(source)
    return tuple(sources)


def terms_of(source: str, data: DataConfig) -> tuple[str, bool]:
    """Return a source's terms of use, and True if they allow only research."""
    # A user's file may have the name of a known source. `data.sources` then contains its path.
    if source in SOURCES and source in data.sources:
        return SOURCES[source].terms, SOURCES[source].research_only
    own = "inventory" if is_inventory(source) else "scenes"
    return data.terms or f"the user's own {own}, without stated terms of use", data.research_only


def terms(sources: Sequence[DataSource]) -> str:
    """Return a sentence about the permitted use of weights that are trained on these sources."""
    if research := [entry.source for entry in sources if entry.research_only]:
        return f"Research use only: trained on {', '.join(research)}. Not for commercial robots."
    own = [entry for entry in sources if entry.source not in SOURCES]
    sentences = [f"Trained on {entry.source}: {entry.terms.rstrip('.')}." for entry in own]
    return " ".join(sentences) or "No restriction from the training data beyond its attribution."
