"""The benchmark command end to end on generated rooms, what it resumes, and its arithmetic."""

from __future__ import annotations

import json

import numpy as np
import pytest
from typer.testing import CliRunner

from training.benchmark import MeanOverSeeds, measure_entries, summarise
from training.benchmark.entries import Entry
from training.benchmark.measure import BenchmarkError, slug
from training.cli import app
from training.evaluation.contenders import Contender
from training.evaluation.intervals import paired_difference
from training.evaluation.metrics import Ratio
from training.evaluation.tasks import Setting
from training.trainer import Trainer

CONFIG = """
name = "rooms-{variant}"
[data]
sources = ["rooms"]
vocabulary = "rooms"
rooms = {rooms}
[machine]
variant = "{variant}"
form = "local"
H1 = 8
H2 = 0
K = 4
[objective]
name = "composite"
[training]
epochs = {epochs}
"""
BASELINES = ("--baseline", "popularity", "--baseline", "EASE")


def write(folder, *, variant="triway", rooms=60, epochs=2):
    path = folder / f"{variant}-{rooms}-{epochs}.toml"
    path.write_text(CONFIG.format(variant=variant, rooms=rooms, epochs=epochs))
    return str(path)


def run(*arguments):
    result = CliRunner().invoke(app, ["benchmark", *arguments])
    return result.exit_code, " ".join(result.output.split())


@pytest.fixture(scope="module")
def finished(tmp_path_factory):
    """A finished small benchmark: (its arguments, its folder)."""
    folder = tmp_path_factory.mktemp("benchmark")
    where = folder / "reports"
    arguments = (
        write(folder), write(folder, variant="rbm"), "--folder", str(where), "--quick", *BASELINES,
    )  # fmt: skip
    code, output = run(*arguments)
    assert code == 0, output
    return arguments, where


def test_every_row_is_measured_and_compared(finished):
    _, folder = finished
    results = json.loads((folder / "results.json").read_text())
    assert results["ours"] == "rooms-triway"
    rows = {cell["row"] for cell in results["cells"]}
    assert rows == {"rooms-triway", "rooms-rbm", "popularity", "EASE"}
    cells = {(c["row"], c["source"], c["task"], c["metric"]): c["figure"] for c in results["cells"]}
    for difference in results["differences"]:
        key = (difference["source"], difference["task"], difference["metric"])
        gap = cells["rooms-triway", *key]["value"] - cells[difference["row"], *key]["value"]
        assert difference["figure"]["value"] == pytest.approx(gap)
    compared = {(d["row"], d["task"]) for d in results["differences"]}
    assert {("EASE", "T2 missing"), ("rooms-rbm", "T1b completion")} <= compared
    assert "### T2 missing: MRR" in (folder / "results.md").read_text()


def test_one_source_is_also_the_pool(finished):
    _, folder = finished
    cells = json.loads((folder / "results.json").read_text())["cells"]
    mrr = {
        (c["row"], c["source"]): c["figure"]["value"]
        for c in cells
        if (c["task"], c["metric"]) == ("T2 missing", "MRR")
    }
    for row in ("EASE", "rooms-triway"):
        assert mrr[row, "rooms"] == pytest.approx(mrr[row, "pooled"])


def test_the_same_command_computes_nothing_again(finished, monkeypatch):
    arguments, folder = finished
    before = (folder / "results.json").read_bytes()

    def trained(*_):
        raise AssertionError("a finished row was trained again")

    monkeypatch.setattr(Trainer, "run", trained)
    code, output = run(*arguments)
    assert code == 0, output
    assert (folder / "results.json").read_bytes() == before


def test_a_lost_report_is_made_again_from_the_finished_run(finished, monkeypatch):
    arguments, folder = finished
    report = folder / "rooms-triway/seed-0/rooms.json"
    before = json.loads(report.read_text())["tasks"]["T2 missing"]["outcome"]
    report.unlink()
    monkeypatch.setattr(Trainer, "run", None)
    code, output = run(*arguments)
    assert code == 0, output
    assert json.loads(report.read_text())["tasks"]["T2 missing"]["outcome"] == before


def test_every_trial_is_kept(finished):
    _, folder = finished
    lines = (folder / "ease/seed-0/trials.jsonl").read_text().splitlines()
    trials = [json.loads(line) for line in lines]
    assert len([t for t in trials if t["model"] == "EASE"]) > 1
    assert all(np.isfinite(t["validation"]) and t["seconds"] >= 0 for t in trials)


def test_reports_of_another_configuration_are_not_gone_on_with(finished, tmp_path):
    _, folder = finished
    other = write(tmp_path, epochs=1)
    arguments = (other, "--folder", str(folder), "--quick", "--baseline", "none")
    code, output = run(*arguments)
    assert code == 1
    assert "another configuration of rooms-triway" in output


@pytest.mark.parametrize(
    ("others", "message"),
    [
        (("--baseline", "nobody"), "unknown baselines ['nobody']"),
        (("--data", "nowhere"), ""),
    ],
)
def test_bad_requests_are_named(tmp_path, others, message):
    code, output = run(write(tmp_path), "--folder", str(tmp_path / "x"), "--quick", *others)
    assert message in output
    assert code == (1 if message else 0)


def test_machines_must_share_their_scenes(tmp_path):
    code, output = run(write(tmp_path), write(tmp_path, variant="rbm", rooms=50), "--quick")
    assert code == 1
    assert "different data sections" in output


def ratio(values):
    return Ratio(np.array(values, dtype=np.float64), np.ones(len(values)))


def test_a_mean_over_seeds_is_resampled_scene_by_scene():
    a, b = ratio([0.0, 1.0, 1.0, 0.0]), ratio([1.0, 1.0, 0.0, 0.0])
    mean = MeanOverSeeds([a, b])
    together = ratio([0.5, 1.0, 0.5, 0.0])
    assert mean.value == together.value
    np.testing.assert_allclose(mean.draws(), together.draws())
    difference = paired_difference(mean, together)
    assert (difference.low, difference.high) == pytest.approx((0.0, 0.0))


def test_a_mean_over_seeds_needs_the_same_scenes():
    with pytest.raises(ValueError, match="different numbers of scenes"):
        MeanOverSeeds([ratio([1.0]), ratio([1.0, 0.0])])
    with pytest.raises(ValueError, match="at least one"):
        MeanOverSeeds([])


def test_a_summary_needs_our_row():
    with pytest.raises(ValueError, match="no report of ours"):
        summarise({}, "ours")


def test_interrupting_keeps_what_is_finished(tmp_path, finished):
    """Ctrl-C in the second row: the first row's report is there and is not made again."""
    made = []

    def make(name):
        def maker(_, __):
            made.append(name)
            if name == "second" and made.count(name) == 1:
                raise KeyboardInterrupt
            return Contender()

        return maker

    setting = Setting(scenes=_no_scenes(), structure=None)
    entries = [Entry(name, 0, name, make(name)) for name in ("first", "second")]

    def go():
        return measure_entries(tmp_path, entries, {"none": setting}, ["T2 missing"], print)

    with pytest.raises(KeyboardInterrupt):
        go()
    assert set(go()) == {("first", 0), ("second", 0)}
    assert made == ["first", "second", "second"]


def _no_scenes():
    class Nothing:
        scenes = ()

    return Nothing()


def test_a_changed_row_is_refused(tmp_path):
    setting = Setting(scenes=_no_scenes(), structure=None)
    for identity in ("one", "two"):
        entry = Entry("row", 0, identity, lambda *_: Contender())
        if identity == "two":
            with pytest.raises(BenchmarkError, match="another configuration of row"):
                measure_entries(tmp_path, [entry], {"none": setting}, ["T2 missing"], print)
        else:
            measure_entries(tmp_path, [entry], {"none": setting}, ["T2 missing"], print)


def test_names_of_folders():
    assert slug("frequency table p(i | a, j) × EASE") == "frequency-table-p-i-a-j-ease"
