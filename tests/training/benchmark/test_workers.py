"""Several processes: a row's own failure, and any other."""

from __future__ import annotations

import pytest

from tests.training.evaluation.scenes import NO_STRUCTURE, scene, tensors
from training.benchmark import Entry, Material, Plan
from training.benchmark.measure import place_of
from training.benchmark.workers import fill
from training.evaluation.contenders import Contender
from training.evaluation.tasks import Setting


def answers(*_):
    return lambda _: Contender()


def diverges(*_):
    raise FloatingPointError("loss is nan")


def plan(folder):
    settings = {"none": Setting(tensors([scene([0], name="one")]), NO_STRUCTURE)}
    return Plan(folder, Material(None, None, "these scenes"), settings, ["T2 missing"])


def test_a_row_that_fails_stops_no_other(tmp_path):
    """One worker takes the failing row first and goes on to the rest."""
    makers = {"first": diverges, "second": answers, "third": diverges, "fourth": answers}
    entries = [Entry(name, 3, name, make) for name, make in makers.items()]
    said = []
    failed = fill(
        plan(tmp_path), entries, lambda row, _, note: said.append((row, note)), 1,
        failures=(FloatingPointError,),
    )  # fmt: skip
    assert {key: str(error) for key, error in failed.items()} == {
        ("first", 3): "loss is nan", ("third", 3): "loss is nan",
    }  # fmt: skip
    for name in makers:
        assert (place_of(tmp_path, name, 3) / "none.json").exists() is (
            name in ("second", "fourth")
        )
    assert {("second", "done"), ("fourth", "done")} <= set(said)


def test_what_is_not_a_rows_own_failure_is_raised(tmp_path):
    entries = [Entry("first", 0, "first", diverges), Entry("second", 0, "second", answers)]
    with pytest.raises(FloatingPointError, match="loss is nan"):
        fill(plan(tmp_path), entries, print, 1)
