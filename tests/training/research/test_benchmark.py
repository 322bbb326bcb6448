import json

import pytest

from tests.training.commands import invoke, small_config, write_config
from training.evaluation.tasks import TASKS
from training.fit.configuration import ConfigError
from training.fit.relation_weights import RelationFit
from training.fit.trainer import Trainer
from training.research.benchmark import DEFAULT, chosen_tasks, read_configs
from training.research.measure import baseline_entries
from training.runs.folder import load_run

pytestmark = pytest.mark.slow

BASELINES = ("popularity", "EASE", "frequency table, completing")
MACHINES = {"rooms-triway", "rooms-rbm"}
REFERENCES = {"independent classes", "held-out scenes (floor)"}
TASK_NAMES = ("T1b", "T2 missing", "T3 alarms", "T4", "Calibration")
# In this process, where tests can look on; workers have a test of their own.
HERE = ("--workers", "1", "--seeds", "1", "--limit", "30")
ROWS = """
[[row]]
name = "wide"
what = "more hidden units"
changes = { "machine.units" = 12 }
[[row]]
name = "no-counts"
what = "instances are not counted"
changes = { "machine.without" = ["n"] }
[[row]]
name = "diverging"
what = "far too fast"
changes = { "objects.learning_rate" = 1e30 }
"""


def write(folder, *, variant="triway", rooms=60):
    config = small_config(f"rooms-{variant}", variant, rooms=rooms)
    return write_config(folder / f"{variant}-{rooms}.toml", config, {"objects.steps": 40})


def read(folder):
    results = json.loads((folder / "results.json").read_text())
    keys = ("row", "source", "task", "metric")
    cells = {tuple(cell[key] for key in keys): cell["figure"]["value"] for cell in results["cells"]}
    return results, cells


def trained(folder):
    return load_run(next(folder.glob("seed-0-*/run"))).machine


@pytest.fixture(scope="module")
def finished(tmp_path_factory):
    folder = tmp_path_factory.mktemp("benchmark")
    named = [("--baseline", name) for name in BASELINES] + [("--task", x) for x in TASK_NAMES]
    arguments = (
        *(write(folder, variant=variant) for variant in ("triway", "rbm")),
        *("--folder", folder / "reports", *HERE),
        *(word for pair in named for word in pair),
    )
    invoke("benchmark", *arguments)
    return arguments, folder / "reports/rooms"


def test_every_row_is_measured_and_compared(finished):
    results, cells = read(finished[1])
    assert results["ours"] == "rooms-triway"
    assert {row for row, *_ in cells} == MACHINES | set(BASELINES) | REFERENCES
    assert {key[0] for key in cells if key[2] == "T4 generate"} == MACHINES | REFERENCES
    for difference in results["differences"]:
        key = (difference["source"], difference["task"], difference["metric"])
        gap = cells["rooms-triway", *key] - cells[difference["row"], *key]
        assert difference["figure"]["value"] == pytest.approx(gap)
    compared = {(d["row"], d["task"]) for d in results["differences"]}
    assert {("EASE", "T2 missing"), ("rooms-rbm", "T1b completion")} <= compared
    text = (finished[1] / "results.md").read_text()
    assert "### T2 missing: MRR, one removed" in text
    machine = trained(finished[1] / "rooms-rbm")
    assert results["parameters"]["rooms-rbm"] == machine.parameter_count
    assert results["parameters"]["popularity"] == machine.spec.V
    assert f"{machine.parameter_count:,}" in text
    # One source is also the pool.
    for row in ("EASE", "rooms-triway"):
        alone, both = (cells[row, x, "T2 missing", "MRR, one removed"] for x in ("rooms", "pooled"))
        assert alone == pytest.approx(both)
    # Machines are measured as they are published: calibrated, with the default alarm.
    for row in MACHINES:
        names = {(task, metric) for name, _, task, metric in cells if name == row}
        assert ("T3 alarms", "alarms, medium, 2 classes") in names
        for question in ("relations", "missing, 2 classes"):
            assert ("Calibration", f"Brier skill, {question}") in names
    plots = {path.stem for path in finished[1].glob("*.png") if path.stat().st_size > 5000}
    assert plots == {f"reliability-{machine}" for machine in MACHINES}


def test_finished_rows_are_never_trained_again(finished, monkeypatch):
    """A lost report is made again from the finished run."""
    arguments, folder = finished
    before = read(folder)
    next(folder.glob("rooms-triway/seed-0-*/rooms-*.json")).unlink()
    monkeypatch.setattr(Trainer, "run", None)
    invoke("benchmark", *arguments)
    assert read(folder) == before


@pytest.mark.parametrize(
    ("others", "message"),
    [
        (("--baseline", "nobody"), "unknown baselines ['nobody']"),
        (("--task", "T9"), "unknown task 'T9'"),
    ],
)
def test_bad_requests_are_named(tmp_path, others, message):
    assert message in invoke("benchmark", write(tmp_path), "--folder", tmp_path, *others, code=1)


def test_configurations_of_other_scenes_are_refused():
    assert [config.name for config in read_configs(DEFAULT)] == [*DEFAULT]
    with pytest.raises(ConfigError, match="two configurations have the name places-rbm"):
        read_configs(["places-rbm", "places-rbm"])
    with pytest.raises(ConfigError, match="different data sections"):
        read_configs(["places-rbm", "knowledge-triway"])


def test_baselines_that_no_seed_changes_are_trained_once():
    every = {entry.name for entry in baseline_entries(0)}
    again = {entry.name for entry in baseline_entries(1)}
    assert again == {
        "scikit-learn BernoulliRBM", "denoising autoencoder", "ComplEx",
    }  # fmt: skip
    assert again < every
    unrelated = {entry.name for entry in baseline_entries(0, related=False)}
    assert every - unrelated >= {"frequency table", "frequency table p(i | a, j)", "ComplEx"}
    assert {"popularity", "EASE", "naive Bayes of rooms"} <= unrelated


def test_tasks_are_chosen_by_name_or_prefix():
    assert chosen_tasks(None) == tuple(TASKS)
    assert chosen_tasks(["T2 missing"]) == ("T2 missing",)
    assert chosen_tasks(["Rooms", "T1"]) == (
        "T1a relations", "T1 pairs", "T1 with evidence", "T1b completion", "Rooms",
    )  # fmt: skip


def ablation(folder):
    path = folder / "rows.toml"
    path.write_text(ROWS)
    folders = ("--rows", path, "--folder", folder / "ablation")
    return "ablate", write(folder), *folders, "--limit", "30"


@pytest.fixture(scope="module")
def ablated(tmp_path_factory):
    folder = tmp_path_factory.mktemp("ablation")
    invoke(*ablation(folder), "--workers", "2")
    return folder / "ablation/rooms-triway"


def test_ablations_are_compared_with_the_full_model(ablated):
    """A diverging row is reported, and weights that are held at zero do not count."""
    results, cells = read(ablated)
    assert results["ours"] == "rooms-triway"
    assert {row for row, *_ in cells} == {"rooms-triway", "wide", "no-counts"}
    assert {gap["row"] for gap in results["differences"]} == {"wide", "no-counts"}
    assert list(results["failures"]) == ["diverging"]
    text = (ablated / "results.md").read_text()
    assert "diverging could not be measured: seed 0: " in text
    assert "| no-counts | instances are not counted |" in text
    machine = trained(ablated / "no-counts")
    assert not machine.n.any()
    weights = machine.parameter_count - machine.n.numel()
    assert results["parameters"]["no-counts"] == weights
    assert f"| no-counts | {weights:,} | " in text


def test_an_interrupted_ablation_goes_on(ablated, tmp_path, monkeypatch):
    epoch, widths = RelationFit.epoch, []

    def interrupted(self, progress):
        widths.append(self.machine.spec.units)
        if len(widths) == 4:
            raise KeyboardInterrupt
        return epoch(self, progress)

    command = (*ablation(tmp_path), "--row", "wide", "--workers", "1")
    monkeypatch.setattr(RelationFit, "epoch", interrupted)
    assert "to continue" in invoke(*command, code=130)
    invoke(*command)
    # The first row has ended. The second one, stopped in its second epoch, starts again.
    assert widths == [3, 3, 12, 12, 12, 12]
    first, again = (read(x)[1] for x in (ablated, tmp_path / "ablation/rooms-triway"))
    assert again == {key: value for key, value in first.items() if key[0] != "no-counts"}


def test_bad_ablations_are_named(tmp_path):
    command = ablation(tmp_path)
    for request, message in (
        ((*command, "--row", "nobody"), "unknown rows ['nobody']: choose from wide"),
        ((*command, "--rows", "nowhere.toml"), "nowhere.toml does not exist"),
        (command[:2], "no shipped ablations"),
    ):
        assert message in invoke(*request, code=1)
    assert not (tmp_path / "ablation").exists()
