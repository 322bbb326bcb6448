"""Several processes: a row's own failure, and any other."""

from __future__ import annotations

import json
from types import SimpleNamespace

import pytest

from tests.training.evaluation.scenes import NO_STRUCTURE, scene, tensors
from training.evaluation.model import Model
from training.evaluation.setting import Setting
from training.research.entries import Entry
from training.research.measure import BenchmarkError, Plan, measure_entries


def answers(*_):
    return Model()


def diverges(*_):
    raise FloatingPointError("loss is nan")


def plan(folder, material="these scenes"):
    settings = {"none": Setting(tensors([scene([0], name="one")]), NO_STRUCTURE)}
    return Plan(folder, SimpleNamespace(digest=material), settings, ["T2 missing"])


@pytest.mark.slow
def test_a_row_that_fails_stops_no_other(tmp_path):
    """Processes take the failing rows and go on to the rest."""
    makers = {"first": diverges, "second": answers, "third": diverges, "fourth": answers}
    entries = [Entry(name, 3, name, make) for name, make in makers.items()]
    said = []
    reports, failed = measure_entries(
        plan(tmp_path), entries, lambda row, _, note: said.append((row, note)), workers=2,
        failures=(FloatingPointError,),
    )  # fmt: skip
    assert failed == {"first": "seed 3: loss is nan", "third": "seed 3: loss is nan"}
    assert set(reports) == {("second", 3), ("fourth", 3)}
    for name in makers:
        report = tmp_path / name / "seed-3" / "none.json"
        assert report.exists() is (name in ("second", "fourth"))
    assert {("second", "done"), ("fourth", "done")} <= set(said)


@pytest.mark.slow
def test_errors_other_than_failures_of_a_row_are_raised(tmp_path):
    entries = [Entry("first", 0, "first", diverges), Entry("second", 0, "second", answers)]
    with pytest.raises(FloatingPointError, match="loss is nan"):
        measure_entries(plan(tmp_path), entries, print, workers=2)


def test_a_folder_of_another_row_or_other_scenes_is_refused(tmp_path):
    def row(identity):
        return Entry("row", 0, identity, answers)

    measure_entries(plan(tmp_path), [row("1")], print)
    with pytest.raises(BenchmarkError, match="another configuration of row"):
        measure_entries(plan(tmp_path), [row("2")], print)
    with pytest.raises(BenchmarkError, match="other training scenes"):
        measure_entries(plan(tmp_path, "other scenes"), [row("1")], print)
    # Nor one that does not say what it learnt from.
    (tmp_path / "row/seed-0/row.json").write_text(json.dumps({"identity": "1"}))
    with pytest.raises(BenchmarkError, match="other training scenes"):
        measure_entries(plan(tmp_path), [row("1")], print)
