"""The benchmark command end to end on generated rooms, what it resumes, and its arithmetic."""

from __future__ import annotations

import json

import pytest
import torch

from tests.training.commands import invoke, small_config, write_config
from training.evaluation.metrics import Figure
from training.evaluation.results import Cell, Difference, Results
from training.evaluation.tasks import TASKS
from training.fit.configuration import ConfigError
from training.fit.trainer import Trainer
from training.research.benchmark import (
    DEFAULT,
    QUICK_BASELINES,
    YARDSTICKS,
    chosen_tasks,
    read_domains,
    shuffled_text,
)
from training.research.entries import baseline_entries
from training.research.plots import recall_points
from training.runs.folder import load_run

pytestmark = pytest.mark.slow

BASELINES = ("--baseline", "popularity", "--baseline", "EASE")
# In this process, where tests can look on; workers have a test of their own.
HERE = ("--workers", "1")
MACHINES = {"rooms-triway", "rooms-rbm"}
REFERENCES = {"independent classes", "held-out scenes (floor)"}


def write(folder, *, variant="triway", rooms=60):
    config = small_config(f"rooms-{variant}", variant, rooms=rooms)
    return write_config(folder / f"{variant}-{rooms}.toml", config)


@pytest.fixture(scope="module")
def finished(tmp_path_factory):
    """A finished small benchmark: (its arguments, the folder of its domain)."""
    folder = tmp_path_factory.mktemp("benchmark")
    where = folder / "reports"
    arguments = (
        *(write(folder, variant=variant) for variant in ("triway", "rbm")),
        "--folder", where, "--quick",
        "--shuffled", *HERE,
    )  # fmt: skip
    invoke("benchmark", *arguments)
    return arguments, where / "rooms"


@pytest.fixture(scope="module")
def results(finished):
    return json.loads((finished[1] / "results.json").read_text())


def test_every_row_is_measured_and_compared(finished, results):
    assert results["ours"] == "rooms-triway"
    cells = {(c["row"], c["source"], c["task"], c["metric"]): c["figure"] for c in results["cells"]}
    assert {row for row, *_ in cells} == MACHINES | set(QUICK_BASELINES) | REFERENCES
    assert {key[0] for key in cells if key[2] == "T4 generate"} == MACHINES | REFERENCES
    for difference in results["differences"]:
        key = (difference["source"], difference["task"], difference["metric"])
        gap = cells["rooms-triway", *key]["value"] - cells[difference["row"], *key]["value"]
        assert difference["figure"]["value"] == pytest.approx(gap)
    compared = {(d["row"], d["task"]) for d in results["differences"]}
    assert {("EASE", "T2 missing"), ("rooms-rbm", "T1b completion")} <= compared
    text = (finished[1] / "results.md").read_text()
    assert "### T2 missing: MRR, one removed" in text
    machine = load_run(finished[1] / "rooms-rbm/seed-0/run").machine
    assert results["parameters"]["rooms-rbm"] == machine.parameter_count
    assert results["parameters"]["popularity"] == machine.spec.V
    assert f"{machine.parameter_count:,}" in text
    # One source is also the pool.
    for row in ("EASE", "rooms-triway"):
        alone, both = (
            cells[row, x, "T2 missing", "MRR, one removed"]["value"] for x in ("rooms", "pooled")
        )
        assert alone == pytest.approx(both)
    # Machines are measured as they are published: calibrated, with the default alarm.
    for row in MACHINES:
        names = {(task, metric) for name, _, task, metric in cells if name == row}
        assert ("T3 alarms", "alarms, medium, 2 classes") in names
        assert ("T2 missing", "MRR, 25 % shown") in names
        for question in ("relations", "missing, 2 classes"):
            assert ("Calibration", f"Brier skill, {question}") in names
        # So few validation scenes allow no judgement of objects and relations.
        for question in ("outliers", "misplaced"):
            assert ("Calibration", f"Brier skill, {question}") not in names


def shuffled(folder, task):
    return json.loads((folder / "shuffled" / task / "results.json").read_text())


@pytest.mark.parametrize(
    ("task", "rows"),
    [
        ("t1a-relations", {"relation popularity", "frequency table"}),
        ("t1-pairs", {"relation popularity", "frequency table"}),
        ("t2-missing", {"popularity", "EASE"}),
    ],
)
def test_the_shuffled_control_has_a_page_for_each_task(finished, task, rows):
    """With the rows that were wanted, and those that the others must fall to."""
    control = shuffled(finished[1], task)
    assert {cell["row"] for cell in control["cells"]} == rows | MACHINES
    assert {gap["row"] for gap in control["differences"]} == (rows | MACHINES) - {control["ours"]}
    text = (finished[1] / "shuffled" / task / "results.md").read_text()
    assert f"above {control['ours']} over the whole interval: " in text


def test_the_control_learns_from_shuffled_scenes_and_is_tested_on_real_ones(finished, results):
    """Popularity finds what it always finds: no class is in more or fewer training scenes."""
    cells, control = (
        {
            (c["row"], c["source"]): c["figure"]
            for c in found["cells"]
            if (c["task"], c["metric"]) == ("T2 missing", "MRR, one removed")
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
    """By their figures on all sources together, not on one of them."""
    above, near = Figure(-0.2, -0.3, -0.1, 9), Figure(-0.1, -0.2, 0.1, 9)
    figures = {
        ("sees more", "x"): near, ("sees more", "pooled"): above,
        ("falls", "x"): above, ("falls", "pooled"): near,
    }  # fmt: skip
    differences = tuple(
        Difference(row, "T2 missing", source, "MRR", figure)
        for (row, source), figure in figures.items()
    )
    text = shuffled_text("T2 missing", Results("popularity", (), differences))
    assert "above popularity over the whole interval: sees more by 0.200." in text
    none = shuffled_text("T2 missing", Results("popularity", (), ()))
    assert "over the whole interval: none." in none


def test_plots_lie_beside_the_results(finished):
    names = {path.stem for path in finished[1].glob("*.png") if path.stat().st_size > 5000}
    assert names == {"recall"} | {f"reliability-{machine}" for machine in MACHINES}


def test_finished_rows_are_never_trained_again(finished, monkeypatch):
    """A lost report is made again from the finished run."""
    arguments, folder = finished
    report = folder / "rooms-triway/seed-0/rooms.json"

    def read():
        outcome = json.loads(report.read_text())["tasks"]["T2 missing"]["outcome"]
        return json.loads((folder / "results.json").read_text()), outcome

    before = read()
    report.unlink()
    monkeypatch.setattr(Trainer, "run", None)
    invoke("benchmark", *arguments)
    assert read() == before


@pytest.mark.parametrize(
    ("others", "message"),
    [
        (("--baseline", "nobody"), "unknown baselines ['nobody']"),
        (("--task", "T9"), "unknown task 'T9'"),
        (("--shuffled", "--task", "T4"), f"at least one of the tasks {', '.join(YARDSTICKS)}"),
    ],
)
def test_bad_requests_are_named(tmp_path, others, message):
    where = ("--folder", tmp_path / "x", "--quick", *HERE)
    assert message in invoke("benchmark", write(tmp_path), *where, *others, code=1)


def test_configurations_of_one_data_section_are_a_domain(tmp_path):
    found = read_domains([*DEFAULT, "open-triway"])
    assert [domain.name for domain in found] == ["indoor", "open"]
    assert [config.name for config in found[0].configs] == [*DEFAULT]
    with pytest.raises(ConfigError, match="two configurations have the name indoor-rbm"):
        read_domains(["indoor-rbm", "indoor-rbm"])
    with pytest.raises(ConfigError, match="different data sections"):
        read_domains([str(write(tmp_path)), str(write(tmp_path, variant="rbm", rooms=50))])


def test_baselines_that_no_seed_changes_are_trained_once():
    every = {entry.name for entry in baseline_entries(0)}
    again = {entry.name for entry in baseline_entries(1)}
    assert again == {
        "scikit-learn BernoulliRBM", "masked transformer", "denoising autoencoder", "ComplEx",
    }  # fmt: skip
    assert again < every


def test_tasks_are_chosen_by_name_or_prefix():
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
