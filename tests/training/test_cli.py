import json
import re
import sys
from dataclasses import replace
from importlib.metadata import packages_distributions
from pathlib import Path

import numpy as np
import pytest

from app.registry import Description, Store, VocabularyEntry
from app.registry.references import AliasTarget
from app.scene import Vocabulary
from tests.conftest import REPOSITORY, run_program
from tests.questions.answers import generate, missing, outliers, relations
from tests.registry.small_artifacts import description, state
from tests.training.commands import invoke, small_config, write_config
from tests.training.scenes import request
from training.datasets import read_scenes
from training.datasets.records import digest_of
from training.fit.offset_statistics import fit_offsets
from training.runs.config_files import load_config, with_settings
from training.runs.folder import RunError
from training.runs.pipeline import prepare
from training.runs.publish import publish_rounded, refit

SIZES = {"machine.units": 4, "machine.states": 4, "machine.K": 4}
CONFIG = with_settings(
    small_config(rooms=260), SIZES | {"objects.steps": 300, "relations.epochs": 3}
)


def check_equal(arrays, others) -> None:
    assert arrays.keys() == others.keys()
    for name, array in arrays.items():
        assert np.array_equal(others[name], array), name


def check_offsets(artifact, config) -> None:
    """The offsets are those of the training scenes; test scenes have no part in them."""
    parts, V = prepare(config, Path()).parts, len(artifact.model.vocabulary)
    check_equal(fit_offsets(parts["train"], V).tensors(), artifact.model.offsets.tensors())
    leaking = fit_offsets([*parts["train"], *parts["test"]], V)
    assert not np.array_equal(leaking.pair_scenes, artifact.model.offsets.pair_scenes)


def check_refit(artifact, store) -> None:
    """`publish NAME@VERSION` changes only statistics."""
    invoke("publish", "rooms-triway@1.0.0", "1.0.1", "--store", store)
    again = Store(store).load("rooms-triway", "1.0.1")
    check_equal(artifact.model.weights.arrays, again.model.weights.arrays)
    check_equal(artifact.model.counts.tensors(), again.model.counts.tensors())
    before, after = artifact.manifest, again.manifest
    same = {}
    for name in ("outlier_lines", "room_lines"):
        first, again_fitted = (getattr(one.calibration, name) for one in (before, after))
        assert (first is None) == (again_fitted is None)
        for level, line in first.model_dump().items() if first else ():
            assert again_fitted.model_dump()[level] == pytest.approx(line, abs=0.01), level
        same[name] = first
    assert after.calibration.model_copy(update=same) == before.calibration
    assert set(after.metrics) == set(before.metrics)
    other = tuple(source.model_copy(update={"digest": "0" * 64}) for source in before.data)
    changed = replace(artifact, manifest=before.model_copy(update={"data": other}))
    with pytest.raises(RunError, match="the scenes of rooms have changed"):
        refit(changed, Path(), Store(store), "1.0.2")


def test_publish_renews_the_names_of_classes(tmp_path):
    shipped = Store(REPOSITORY / "model_store")
    old = shipped.load(*shipped.resolve("places-rbm"))
    version = old.manifest.version
    vocabulary = old.manifest.vocabulary.vocabulary()
    loo = next(entry for entry in vocabulary.objects if "loo" in entry.aliases)
    fewer = [replace(entry, aliases=("bog",) * (entry == loo)) for entry in vocabulary.objects]
    entry = VocabularyEntry.of(
        Vocabulary(fewer, vocabulary.room_types), old.model.spec.A, old.manifest.vocabulary.profiles
    )
    fields = {name: getattr(old.manifest, name) for name in Description.model_fields}
    publish_rounded(Store(tmp_path), Description(**fields | {"vocabulary": entry}), old.model)
    done = invoke("publish", f"places-rbm@{version}", "99.0.0", "--names", "--store", tmp_path)
    assert "published places-rbm@99.0.0" in done
    new = Store(tmp_path).load("places-rbm", "99.0.0")
    assert new.model.vocabulary.objects == old.model.vocabulary.objects
    assert new.manifest.metrics == old.manifest.metrics
    check_equal(old.model.weights.arrays, new.model.weights.arrays)
    invoke("publish", tmp_path, "1.0.0", "--names", "--store", tmp_path, code=1)


@pytest.mark.slow
def test_training_imports_nothing_that_only_checks_need():
    """The training image has `requirements-training.lock` alone."""
    files = (REPOSITORY / f"requirements-{name}.lock" for name in ("dev", "training"))
    pinned = (set(re.findall(r"^([^=\s]+)==", file.read_text(), re.MULTILINE)) for file in files)
    checks = next(pinned) - next(pinned)
    modules = [
        module
        for module, names in packages_distributions().items()
        if {re.sub(r"[-_.]+", "-", name).lower() for name in names} <= checks
    ]
    assert "pytest" in modules
    blocked = f"import sys; sys.modules.update(dict.fromkeys({modules!r}))"
    run_program(sys.executable, "-c", f"{blocked}; import training.cli")


@pytest.mark.slow
def test_from_rooms_to_answers(tmp_path):
    config = write_config(tmp_path / "config.toml", CONFIG)
    folders = ("--runs", tmp_path / "runs", "--store", tmp_path / "store")
    invoke("train", config, *folders, "--publish", "1.0.0")
    first = AliasTarget(name="rooms-triway", version="1.0.0")
    Store(tmp_path / "store").set_alias("default", first)
    figures = tmp_path / "figures.json"
    invoke("evaluate", "default", *folders[2:], "--json", figures)
    tables = json.loads(figures.read_text())
    artifact = Store(tmp_path / "store").load("rooms-triway", "1.0.0")
    # The card of the stored model has the figures that are measured on it again.
    metrics = [m for m in artifact.manifest.metrics if m.task != "Long chains"]
    card = {(m.task, m.source, m.metric): m.value for m in metrics}
    again = {(r["task"], r["source"], r["metric"]): r["value"] for r in tables["default"]}
    assert again == pytest.approx(card, abs=1e-6)
    # Everyday facts are measured where their folder is.
    assert {task.split()[0] for task, _, _ in card} - {"Everyday"} == {
        "T1", "T1a", "T1b", "T2", "T2-at", "T3", "T3b", "T3c", "T4", "Calibration", "Offsets",
        "Counts", "Rooms",
    }  # fmt: skip
    check_offsets(artifact, load_config(str(config)))
    check_refit(artifact, tmp_path / "store")
    model = artifact.model
    scene = request(model, "bed", "nightstand", "lamp")
    assert missing(model, scene)
    assert relations(model, scene)
    assert len(outliers(model, scene).outliers) == 3
    assert len(generate(model, scene, seed=0, steps=5)) == 1


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("train", "nowhere.toml"), "no configuration"),
        (
            ("train", "places-triway", "--data", "nowhere"),
            "18 of 19 files of scenes are missing in nowhere: procthor.jsonl.gz",
        ),
        (("train", "places-rbm", "--data", "nowhere"), "docs/training.md (The public data sets)"),
        (("publish", "nowhere", "1.0.0"), "no finished run"),
        (("publish", "nowhere@1.0.0", "1.0.1", "--promote"), "app.registry alias` moves"),
        (("publish", "nowhere", "1.0.0", "--alias", "lab"), "--alias belongs to --promote"),
        (("evaluate", "nowhere", "--store", "nowhere"), "error"),
        (("compare", "nowhere"), "nor a model in model_store: no model or alias has the name"),
        (("compare", "baselines"), "choose a first model that was trained"),
    ],
)
def test_errors_are_one_clear_line(arguments, message):
    assert message in invoke(*arguments, code=1)


def test_a_stored_model_is_evaluated_on_files(tmp_path):
    store = tmp_path / "store"
    room = '{"objects": ["bed", "lamp", "rug"]}\n'
    files = []
    for name, text in (("seen.jsonl", room * 3), ("homes.jsonl", room * 2)):
        (tmp_path / name).write_text(text)
        files += ["--file", tmp_path / name]
    scenes = [replace(scene, source="seen") for scene in read_scenes(tmp_path / "seen.jsonl")]
    learnt = {"source": "seen", "scenes": 3, "digest": digest_of(scenes), "terms": "MIT"}
    Store(store).publish(description("tiny", data=[learnt | {"research_only": False}]), state())
    figures = tmp_path / "figures.json"
    output = invoke("evaluate", "tiny", *files, "--store", store, "--json", figures)
    assert "tiny: seen is training data of this model" in output
    assert "tiny: 2 of 6 objects are left out, because their labels are unknown" in output
    rows = json.loads(figures.read_text())["tiny"]
    origins = {(Path(row["file"]).name, row["source"], row["in_training"]) for row in rows}
    assert origins == {("seen.jsonl", "seen", True), ("homes.jsonl", "homes", False)}
    refused = invoke("evaluate", "tiny", *files, "--store", store, "--source", "rooms", code=1)
    assert "--file replaces the scenes of --data and --source" in refused


def test_the_store_is_that_of_the_service(tmp_path, monkeypatch):
    """`SCENE_STORE` is the default of `--store`, as in `python -m app.registry`."""
    monkeypatch.setenv("SCENE_STORE", str(tmp_path / "served"))
    assert "nor a model in " + str(tmp_path / "served") in invoke("compare", "nowhere", code=1)
    own = invoke("compare", "nowhere", "--store", tmp_path / "own", code=1)
    assert "nor a model in " + str(tmp_path / "own") in own
    monkeypatch.setenv("SCENE_STORE", "")
    assert "nor a model in model_store" in invoke("compare", "nowhere", code=1)


def test_the_version_is_checked_before_training(tmp_path):
    store = tmp_path / "store"
    Store(store).publish(description("tiny", "1.2.0"), state())
    config = write_config(tmp_path / "config.toml", CONFIG.model_copy(update={"name": "tiny"}))
    for version, message in (
        ("1.2.0", "tiny@1.2.0 is already published"),
        ("abc", "error: a version must be MAJOR.MINOR.PATCH"),
    ):
        for command in (
            ("train", config, "--runs", tmp_path / "runs", "--publish", version),
            ("publish", "tiny@1.2.0", version),
        ):
            output = invoke(*command, "--store", store, code=1)
            assert message in output
            assert ("the newest version is 1.2.0" in output) == (version == "1.2.0")
    assert not (tmp_path / "runs").exists()


def test_the_error_about_missing_own_scenes_names_their_folder(tmp_path):
    config = write_config(tmp_path / "config.toml", CONFIG, {"data.sources": ("../lost.jsonl",)})
    assert "Pass this folder with --data" in invoke("train", config, code=1)


def test_labels_outside_the_vocabulary_are_named(tmp_path):
    scenes = [{"objects": ["bed", "pillow"]}] * 30 + [{"objects": ["bed", "perch"]}] * 3
    (tmp_path / "own.jsonl").write_text("".join(f"{json.dumps(scene)}\n" for scene in scenes))
    own = {"data.sources": ("own.jsonl",), "objects.steps": 1}
    config = write_config(tmp_path / "config.toml", CONFIG, own)
    line = '1 label in 3 scenes is not in the vocabulary: "perch" (3 scenes); it is left out'
    assert line in invoke("train", config, "--runs", tmp_path / "runs")


def test_a_final_run_is_not_promoted_by_comparison(tmp_path):
    config = write_config(tmp_path / "config.toml", CONFIG, {"objects.steps": 1})
    output = invoke("train", config, "--final", "--runs", tmp_path / "runs")
    assert "trained in" in output
    assert "next:" not in output
    folder = tmp_path / "runs/rooms-triway/final-seed-0"
    text = invoke("publish", folder, "1.0.0", "--promote", "--store", tmp_path / "store", code=1)
    assert "is a final run without test scenes" in text
    assert "`python -m app.registry alias` moves an alias without a comparison" in text
    assert "object classes" not in text  # refused before the scenes are read
