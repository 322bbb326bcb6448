"""The benchmark command end to end on generated rooms, what it resumes, and its arithmetic."""

from __future__ import annotations

import json

import numpy as np
import pytest
import torch
from typer.testing import CliRunner

from tests.training.evaluation.scenes import NO_STRUCTURE, scene, tensors
from training.cli import app
from training.config import ConfigError
from training.evaluation.contenders import Contender
from training.evaluation.intervals import Figure, paired_difference
from training.evaluation.metrics import Ratio
from training.evaluation.tasks import TASKS, Setting
from training.experiments.benchmark import (
    QUICK_BASELINES,
    YARDSTICKS,
    chosen_tasks,
    default_configs,
    read_domains,
    shuffled_text,
)
from training.experiments.measure import BenchmarkError, Plan, measure_rows
from training.experiments.plots import read_curve, recall_points
from training.experiments.results import Cell, Difference, MeanOverSeeds, Results, summarise
from training.experiments.rows import Material, Row, baseline_rows
from training.runs import load_run
from training.trainer import Trainer

pytestmark = pytest.mark.slow

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
# In this process, where tests can look on; workers have a test of their own.
HERE = ("--workers", "1")
MACHINES = {"rooms-triway", "rooms-gbm", "rooms-rbm"}
REFERENCES = {"independent classes", "held-out scenes (floor)"}


def write(folder, *, variant="triway", rooms=60, epochs=2):
    path = folder / f"{variant}-{rooms}-{epochs}.toml"
    path.write_text(CONFIG.format(variant=variant, rooms=rooms, epochs=epochs))
    return str(path)


def run(*arguments):
    result = CliRunner().invoke(app, ["benchmark", *arguments])
    return result.exit_code, " ".join(result.output.split())


@pytest.fixture(scope="module")
def finished(tmp_path_factory):
    """A finished small benchmark: (its arguments, the folder of its domain)."""
    folder = tmp_path_factory.mktemp("benchmark")
    where = folder / "reports"
    arguments = (
        *(write(folder, variant=variant) for variant in ("triway", "gbm", "rbm")),
        "--folder", str(where), "--quick",
        "--seed-protocol", "--shuffled", *HERE,
    )  # fmt: skip
    code, output = run(*arguments)
    assert code == 0, output
    return arguments, where / "rooms"


@pytest.fixture(scope="module")
def results(finished):
    return json.loads((finished[1] / "results.json").read_text())


def test_every_row_is_measured_and_compared(finished, results):
    assert results["ours"] == "rooms-triway"
    rows = {cell["row"] for cell in results["cells"]}
    assert rows == MACHINES | set(QUICK_BASELINES) | REFERENCES
    cells = {(c["row"], c["source"], c["task"], c["metric"]): c["figure"] for c in results["cells"]}
    for difference in results["differences"]:
        key = (difference["source"], difference["task"], difference["metric"])
        gap = cells["rooms-triway", *key]["value"] - cells[difference["row"], *key]["value"]
        assert difference["figure"]["value"] == pytest.approx(gap)
    compared = {(d["row"], d["task"]) for d in results["differences"]}
    assert {("EASE", "T2 missing"), ("rooms-rbm", "T1b completion")} <= compared
    assert "### T2 missing: MRR" in (finished[1] / "results.md").read_text()


def test_machines_are_measured_as_they_are_published(results):
    """Calibrated, with the default alarm, told the room type where the table says so."""
    found = {(c["row"], c["task"], c["metric"]) for c in results["cells"]}
    for row in MACHINES:
        assert (row, "T3 outliers, uniform", "alarms in untouched scenes") in found
        assert (row, "T2 missing, room type given", "MRR, room type withheld") in found
        for question in ("relations", "missing", "outliers", "misplaced"):
            assert (row, "Calibration", f"Brier skill, {question}") in found


def test_references_stand_in_the_tables_of_generation(results):
    rows = {c["row"] for c in results["cells"] if c["task"] == "T4 generate"}
    assert rows == MACHINES | REFERENCES


def test_weights_are_counted(finished, results):
    machine = load_run(finished[1] / "rooms-rbm/seed-0/run").machine
    assert results["parameters"]["rooms-rbm"] == machine.parameter_count
    assert results["parameters"]["popularity"] == machine.spec.V
    assert f"{machine.parameter_count:,}" in (finished[1] / "results.md").read_text()


def test_the_seed_protocol_has_a_page_of_its_own(finished):
    folder = finished[1] / "seed-protocol"
    protocol = json.loads((folder / "results.json").read_text())
    assert {cell["task"] for cell in protocol["cells"]} == {"Seed T1", "Seed T2", "Seed T3"}
    assert {cell["row"] for cell in protocol["cells"]} == MACHINES
    assert protocol["paper"]["T3 error measure"]["Triway"] == 0.0789
    assert not protocol["differences"]
    assert "# Seed protocol" in (folder / "results.md").read_text()
    config = json.loads((folder / "rooms-rbm/seed-0/run/config.json").read_text())
    assert config["data"]["split"] == "random"


def shuffled(folder, task):
    return json.loads((folder / "shuffled" / task / "results.json").read_text())


@pytest.mark.parametrize(
    ("task", "rows"),
    [
        ("t1a-relations", {"relation popularity", "frequency table"}),
        ("t1-pairs", {"relation popularity", "frequency table"}),
        ("t2-missing", {"popularity", "EASE"}),
        ("t2-partial", {"popularity", "EASE"}),
    ],
)
def test_the_shuffled_control_has_a_page_for_each_task(finished, task, rows):
    """With the rows that were wanted, and those that the others must fall to."""
    control = shuffled(finished[1], task)
    assert {cell["row"] for cell in control["cells"]} == rows | MACHINES
    assert {gap["row"] for gap in control["differences"]} == (rows | MACHINES) - {control["ours"]}
    text = (finished[1] / "shuffled" / task / "results.md").read_text()
    assert f"Above {control['ours']} with the whole interval: " in text


def test_the_control_learns_from_other_scenes_and_is_asked_about_the_same(finished, results):
    """Popularity finds what it always finds: no class is in more or fewer training scenes."""
    cells, control = (
        {
            (c["row"], c["source"]): c["figure"]
            for c in found["cells"]
            if (c["task"], c["metric"]) == ("T2 missing", "MRR")
        }
        for found in (results, shuffled(finished[1], "t2-missing"))
    )
    assert control["popularity", "pooled"] == cells["popularity", "pooled"]
    assert control["EASE", "pooled"] != cells["EASE", "pooled"]
    first, second = (
        load_run(finished[1] / part / "rooms-rbm/seed-0/run").machine for part in ("", "shuffled")
    )
    assert not torch.equal(first.W, second.W)


def test_rows_above_the_yardstick_are_named():
    figures = {"sees more": Figure(-0.2, -0.3, -0.1, 9), "falls": Figure(-0.1, -0.2, 0.1, 9)}
    differences = tuple(
        Difference(row, "T2 missing", source, "MRR", figure)
        for row, figure in figures.items()
        for source in ("x", "pooled")
    )
    text = shuffled_text("T2 missing", Results("popularity", (), differences))
    assert "Above popularity with the whole interval: sees more by 0.200." in text
    none = shuffled_text("T2 missing", Results("popularity", (), ()))
    assert "with the whole interval: no row." in none


def test_only_tasks_with_a_yardstick_are_asked_on_shuffled_scenes(tmp_path):
    code, output = run(write(tmp_path), "--quick", "--shuffled", "--task", "T4", *HERE)
    assert code == 1
    assert f"only {', '.join(YARDSTICKS)} are asked" in output


def test_plots_lie_beside_the_results(finished):
    names = {path.stem for path in finished[1].glob("*.png") if path.stat().st_size > 5000}
    assert names == {"learning-curves", "recall"} | {
        f"reliability-{machine}" for machine in MACHINES
    }


def test_a_curve_is_read_back(finished):
    epochs, values = read_curve(finished[1] / "rooms-triway/seed-0/run/curve.csv", "mrr_validation")
    assert epochs == [1, 2]
    assert all(0 < value <= 1 for value in values)


def test_one_source_is_also_the_pool(results):
    cells = results["cells"]
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
    arguments = (other, "--folder", str(folder.parent), "--quick", "--baseline", "none", *HERE)
    code, output = run(*arguments)
    assert code == 1
    assert "another configuration of rooms-triway" in output


@pytest.mark.parametrize(
    ("others", "message"),
    [
        (("--baseline", "nobody"), "unknown baselines ['nobody']"),
        (("--task", "T9"), "unknown task 'T9'"),
    ],
)
def test_bad_requests_are_named(tmp_path, others, message):
    code, output = run(write(tmp_path), "--folder", str(tmp_path / "x"), "--quick", *HERE, *others)
    assert (code, message in output) == (1, True)


def test_some_tasks_are_measured_and_the_rest_later(tmp_path, monkeypatch):
    arguments = (
        write(tmp_path, epochs=1), "--folder", str(tmp_path), "--quick", "--baseline", "none",
        *HERE,
    )  # fmt: skip
    code, output = run(*arguments, "--task", "T2 missing")
    assert code == 0, output
    tasks = json.loads((tmp_path / "rooms/rooms-triway/seed-0/rooms.json").read_text())["tasks"]
    assert set(tasks) == {"T2 missing"}
    monkeypatch.setattr(Trainer, "run", None)
    code, output = run(*arguments, "--task", "T1")
    assert code == 0, output
    more = json.loads((tmp_path / "rooms/rooms-triway/seed-0/rooms.json").read_text())["tasks"]
    assert set(more) == {
        "T2 missing", "T1a relations", "T1 pairs", "T1 with evidence", "T1b completion",
    }  # fmt: skip
    kept, first = (t["T2 missing"]["outcome"]["metrics"]["MRR"]["made_of"] for t in (more, tasks))
    assert kept == first


def test_workers_find_what_one_process_finds(finished, tmp_path):
    (first, *_), folder = finished
    arguments = (first, "--folder", str(tmp_path), "--quick", *BASELINES, "--task", "T2 missing")
    code, output = run(*arguments, "--workers", "2")
    assert code == 0, output
    for row in ("rooms-triway", "ease"):
        ours, theirs = (
            json.loads((place / row / "seed-0/rooms.json").read_text())["tasks"]["T2 missing"]
            for place in (tmp_path / "rooms", folder)
        )
        assert ours["outcome"] == theirs["outcome"]


def test_a_failing_worker_is_told(tmp_path):
    broken = tmp_path / "rooms/rooms-triway/seed-0/run/checkpoint.pt"
    broken.parent.mkdir(parents=True)
    broken.write_bytes(b"nothing")
    code, output = run(
        write(tmp_path), "--folder", str(tmp_path), "--quick", "--baseline", "none", "--workers",
        "2", "--task", "T2 missing",
    )  # fmt: skip
    assert (code, "checkpoint.pt cannot be read" in output) == (1, True)


def test_machines_of_one_domain_share_their_scenes(tmp_path):
    code, output = run(write(tmp_path), write(tmp_path, variant="rbm", rooms=50), "--quick")
    assert code == 1
    assert "different data sections" in output


def test_configurations_of_one_data_section_are_a_domain():
    found = read_domains(["indoor-rbm", "open-triway", "indoor-triway"])
    assert [domain.name for domain in found] == ["indoor", "open"]
    assert [config.name for config in found[0].configs] == ["indoor-rbm", "indoor-triway"]
    with pytest.raises(ConfigError, match="two configurations are called indoor-rbm"):
        read_domains(["indoor-rbm", "indoor-rbm"])


def test_the_default_domains_begin_with_their_triway_machine():
    domains = read_domains(default_configs())
    assert domains[0].name == "indoor"
    assert [config.machine.variant for config in domains[0].configs] == ["triway", "gbm", "rbm"]
    assert all(domain.configs[0].machine.variant == "triway" for domain in domains)
    assert "everyday-triway" not in default_configs() or domains[1].name == "everyday"


def test_baselines_that_no_seed_changes_are_trained_once():
    every = {entry.name for entry in baseline_rows(0)}
    again = {entry.name for entry in baseline_rows(1)}
    assert again == {
        "scikit-learn BernoulliRBM", "masked transformer", "denoising autoencoder",
        "autoencoder, heavily masked", "ComplEx",
    }  # fmt: skip
    assert again < every


def test_tasks_go_by_name_or_by_how_they_begin():
    assert chosen_tasks(None, quick=False) == tuple(TASKS)
    assert "Density" not in chosen_tasks(None, quick=True)
    assert chosen_tasks(["T2 missing"], quick=True) == ("T2 missing",)
    assert chosen_tasks(["Density", "T1"], quick=True) == (
        "T1a relations", "T1 pairs", "T1 with evidence", "T1b completion", "Density",
    )  # fmt: skip


def test_recall_curves_follow_the_figures():
    cells = tuple(
        Cell(row, "T2 missing", source, metric, Figure(value, 0, 1, 1), (value,))
        for row, source, metric, value in [
            ("a", "pooled", "top-10", 0.5), ("a", "pooled", "top-1", 0.2), ("a", "x", "top-1", 0.3),
            ("a", "pooled", "MRR", 1.0), ("b", "pooled", "top-1", 0.4),
        ]
    )  # fmt: skip
    found = recall_points(Results("a", cells, ()), "T2 missing", "top-", "pooled")
    assert found == {"a": [(1, 0.2), (10, 0.5)], "b": [(1, 0.4)]}


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


def test_interrupting_keeps_what_is_finished(tmp_path):
    """Ctrl-C in the second row: the first row's report is there and is not made again."""
    made = []

    def make(name):
        def maker(*_):
            made.append(name)
            if name == "second" and made.count(name) == 1:
                raise KeyboardInterrupt
            return lambda _: Contender()

        return maker

    plan = _plan(tmp_path)
    entries = [Row(name, 0, name, make(name)) for name in ("first", "second")]
    with pytest.raises(KeyboardInterrupt):
        measure_rows(plan, entries, print)
    assert set(measure_rows(plan, entries, print)[0]) == {("first", 0), ("second", 0)}
    assert made == ["first", "second", "second"]


def _plan(folder, material="these scenes"):
    settings = {"none": Setting(tensors([scene([0], name="one")]), NO_STRUCTURE)}
    return Plan(folder, Material(None, None, material), settings, ["T2 missing"])


def test_a_changed_row_is_refused(tmp_path):
    first, second = (Row("row", 0, name, lambda *_: lambda _: Contender()) for name in "12")
    measure_rows(_plan(tmp_path), [first], print)
    with pytest.raises(BenchmarkError, match="another configuration of row"):
        measure_rows(_plan(tmp_path), [second], print)


def test_a_row_that_learnt_from_other_scenes_is_refused(tmp_path):
    entry = Row("row", 0, "row", lambda *_: lambda _: Contender())
    measure_rows(_plan(tmp_path), [entry], print)
    with pytest.raises(BenchmarkError, match="learnt from other scenes"):
        measure_rows(_plan(tmp_path, "other scenes"), [entry], print)


def test_a_folder_that_does_not_say_what_it_learnt_from_is_refused(tmp_path):
    entry = Row("row", 0, "row", lambda *_: lambda _: Contender())
    place = tmp_path / "row/seed-0"
    place.mkdir(parents=True)
    (place / "row.json").write_text(json.dumps({"identity": "row"}))
    with pytest.raises(BenchmarkError, match="learnt from other scenes"):
        measure_rows(_plan(tmp_path), [entry], print)
