"""Metrics of one process: what is counted, and that the number of series has an end."""

from __future__ import annotations

import re
from pathlib import Path

import pytest
from prometheus_client.parser import text_string_to_metric_families

from app.registry import AliasTarget, Artifact, Store, load_model_set
from app.serving.admission import Backlog, Threads, WorkQueue
from app.serving.metrics import Metrics
from app.serving.models import ServedModel, ServedModels
from tests.http.stores import make_store


@pytest.fixture(scope="module")
def models(tmp_path_factory: pytest.TempPathFactory) -> ServedModels:
    # As served, but for the warm-up: nothing is asked here.
    return unwarmed(make_store(tmp_path_factory.mktemp("store")))


def unwarmed(root: Path) -> ServedModels:
    store = load_model_set(Store(root))
    served = {
        key: ServedModel(artifact, WorkQueue(8, Threads(), Backlog(8)))
        for key, artifact in store.entries.items()
        if isinstance(artifact, Artifact)
    }
    return ServedModels(store, served, {})


def samples(metrics: Metrics) -> dict[tuple[str, ...], float]:
    """(name, label values in the order of their names) → value, as Prometheus would read it."""
    return parsed(metrics.exposition().decode())


def parsed(text: str) -> dict[tuple[str, ...], float]:
    return {
        (sample.name, *(sample.labels[name] for name in sorted(sample.labels))): sample.value
        for family in text_string_to_metric_families(text)
        for sample in family.samples
    }


def described(metrics: Metrics) -> dict[str, set[str]]:
    """Every name a query can use → the labels of its series.

    Read from the metrics themselves: most have no series before something has happened.
    """
    found: dict[str, set[str]] = {}
    for collector in metrics.registry._collector_to_names:
        labels = set(collector._labelnames)  # type: ignore[attr-defined]
        (family,) = collector.describe()  # type: ignore[attr-defined]
        if family.type == "histogram":
            found[f"{family.name}_bucket"] = labels | {"le"}
            found[f"{family.name}_sum"] = found[f"{family.name}_count"] = labels
        else:
            found[family.name + ("_total" if family.type == "counter" else "")] = labels
    return found


def test_models_are_told_with_every_alias(models: ServedModels) -> None:
    metrics = Metrics()
    metrics.serving(models.with_alias("night", AliasTarget(name="home", version=None)))
    infos = {key for key, value in samples(metrics).items() if key[0] == "scene_model_info"}
    digests = {key: model.reference.digest for key, model in models.served.items()}
    assert infos == {
        ("scene_model_info", alias, digests[name, version], name, variant, version)
        for alias, name, variant, version in (
            ("default", "home", "triway", "1.0.0"),
            ("candidate", "home", "triway", "1.1.0"),
            ("night", "home", "triway", "1.1.0"),
            ("", "plain", "rbm", "1.0.0"),
            ("", "deep", "gbm", "0.1.0"),
        )
    }


def test_series_of_a_removed_model_go_away_and_stay_away(models: ServedModels) -> None:
    metrics = Metrics()
    metrics.serving(models)
    old = "plain", "1.0.0"
    for key in (old, ("home", "1.0.0")):
        metrics.computed(key, "missing", 3, 0.001, 0.002)

    def names(of: str) -> set[str]:
        return {key[0] for key in samples(metrics) if of in key}

    everything = names("home")
    assert {"scene_pending_rows", "scene_batch_rows_sum", "scene_model_info"} <= everything
    assert names("plain") == everything
    rest = {key: model for key, model in models.served.items() if key[0] != "plain"}
    metrics.serving(ServedModels(models.store, rest, {}))
    assert names("plain") == set()
    assert names("home") == everything
    # A request that still holds the old snapshot reports late.
    metrics.computed(old, "missing", 1, 0.001, 0.002)
    assert names("plain") == set()
    metrics.serving(models)
    metrics.computed(old, "missing", 1, 0.001, 0.002)
    assert samples(metrics)["scene_batch_rows_count", "plain", "missing", "1.0.0"] == 1


def test_a_process_without_a_default_is_not_ready(models: ServedModels) -> None:
    metrics = Metrics()
    metrics.started()
    metrics.serving(ServedModels(models.store, {}, {}))
    found = samples(metrics)
    assert found["scene_start_time_seconds",] > 1.7e9
    assert found["scene_ready_time_seconds",] == 0
    metrics.serving(models)
    ready = samples(metrics)["scene_ready_time_seconds",]
    assert ready >= found["scene_start_time_seconds",]
    metrics.serving(models)
    assert samples(metrics)["scene_ready_time_seconds",] == ready


def test_the_documentation_lists_every_metric(repository: Path) -> None:
    text = (repository / "docs" / "operations.md").read_text("utf-8")
    rows = re.findall(r"^\| `(scene_\w+)` \| (\w+) \|(.*?)\| (.+?) \|$", text, re.MULTILINE)
    listed = {
        name: (kind, set(re.findall(r"`(\w+)`", labels)), meaning)
        for name, kind, labels, meaning in rows
    }
    assert len(listed) == len(rows)
    metrics = Metrics()
    labels = described(metrics)
    told = {}
    for collector in metrics.registry._collector_to_names:
        (family,) = collector.describe()  # type: ignore[attr-defined]
        name = family.name + ("_total" if family.type == "counter" else "")
        of_series = labels[f"{name}_sum" if family.type == "histogram" else name]
        told[name] = (family.type, of_series, family.documentation)
    assert listed == told
    # And every label is explained.
    explained = set(
        re.findall(r"`(\w+)`", " ".join(re.findall(r"^\| (`.+?) \|", text, re.MULTILINE)))
    )
    assert set().union(*labels.values()) - {"le"} <= explained
