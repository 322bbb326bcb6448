"""Where results are written, what is said beside the figures, and what stays there."""

from __future__ import annotations

import json

import numpy as np
import pytest
from typer.testing import CliRunner

from training.benchmark import command
from training.benchmark.measure import BenchmarkError
from training.benchmark.remarks import Asked, remarks
from training.benchmark.sections import (
    SEED_PROTOCOL,
    SHUFFLED,
    TABLES,
    assemble,
    write_protocol,
    write_shuffled,
    write_tables,
)
from training.benchmark.summary import PRIMARY, Cell, Results, is_better, summarise
from training.cli import app
from training.evaluation.intervals import Figure
from training.evaluation.metrics import Ratio
from training.evaluation.report import SourceReport
from training.evaluation.tasks import Outcome

CONFIG = """
name = "rooms-rbm"
[data]
sources = ["rooms"]
vocabulary = "rooms"
rooms = 60
split = "{split}"
[machine]
variant = "rbm"
form = "local"
H1 = 4
H2 = 0
K = 2
[objective]
name = "composite"
[training]
epochs = 1
"""


def arguments(folder, *others, split="group"):
    path = folder / f"{split}.toml"
    path.write_text(CONFIG.format(split=split))
    return (
        str(path), "--folder", str(folder / "reports"), "--quick", "--workers", "1",
        "--task", "T2 missing", "--baseline", "popularity", *others,
    )  # fmt: skip


def run(*arguments):
    result = CliRunner().invoke(app, ["benchmark", *arguments])
    return result.exit_code, " ".join(result.output.split())


def test_a_section_is_kept_by_runs_that_do_not_ask_for_it(tmp_path):
    code, output = run(*arguments(tmp_path, "--shuffled"))
    assert code == 0, output
    folder = tmp_path / "reports/rooms"
    before = json.loads((folder / "results.json").read_text())
    code, output = run(*arguments(tmp_path))
    assert code == 0, output
    assert json.loads((folder / "results.json").read_text()) == before
    assert set(before["shuffled"]) == {"T2 missing"}
    assert "## Shuffled labels" in (folder / "results.md").read_text()
    assert (folder / "shuffled/results.md").read_text().startswith("## Shuffled labels")


def test_what_is_done_is_written_before_the_next_begins(tmp_path, monkeypatch):
    def broken(*_):
        raise BenchmarkError("the control failed")

    monkeypatch.setattr(command, "compare_on_shuffled", broken)
    code, output = run(*arguments(tmp_path, "--seed-protocol", "--shuffled"))
    assert (code, "the control failed" in output) == (1, True)
    folder = tmp_path / "reports/rooms"
    text = (folder / "results.md").read_text()
    assert "### T2 missing: MRR" in text
    assert "## Seed protocol" in text
    for place in (TABLES, SEED_PROTOCOL):
        assert json.loads((folder / place / "results.json").read_text())["results"]["cells"]


def test_a_random_split_fills_no_table(tmp_path):
    for others in ((), ("--shuffled",), ("--shuffled", "--seed-protocol")):
        code, output = run(*arguments(tmp_path, *others, split="random"))
        assert code == 1
        assert "rooms-rbm: data.split" in output
        assert "--seed-protocol" in output
    assert not (tmp_path / "reports").exists()


def test_a_random_split_is_asked_as_the_seed_paper_asks(tmp_path):
    code, output = run(*arguments(tmp_path, "--seed-protocol", split="random"))
    assert code == 0, output
    folder = tmp_path / "reports/rooms"
    values = json.loads((folder / "results.json").read_text())
    assert set(values) == {"seed_protocol"}
    assert "### T2 missing" not in (folder / "results.md").read_text()


def test_every_section_on_disk_is_embedded(tmp_path):
    scenes, cell = {"x": "digest"}, Cell("ours", "T2 missing", "x", "MRR", figure(0.5), (0.5,))
    results = Results("ours", (cell,), ())
    write_tables(tmp_path / TABLES, results, scenes)
    alone = assemble(tmp_path, "domain")
    write_protocol(tmp_path / SEED_PROTOCOL, results, scenes)
    write_shuffled(tmp_path / SHUFFLED, {"T2 missing": results}, scenes)
    text = assemble(tmp_path, "domain")
    assert text.startswith(alone)
    assert "## Seed protocol" in text
    assert "## Shuffled labels" in text
    values = json.loads((tmp_path / "results.json").read_text())
    assert values["seed_protocol"]["cells"] == values["cells"]
    assert values["shuffled"]["T2 missing"]["ours"] == "ours"


def test_a_section_of_other_scenes_is_left_out(tmp_path):
    write_tables(tmp_path / TABLES, Results("ours", (), ()), {"x": "corrected"})
    write_protocol(tmp_path / SEED_PROTOCOL, Results("ours", (), ()), {"x": "digest"})
    text = assemble(tmp_path, "domain")
    assert "## Seed protocol" not in text
    assert "seed-protocol/results.md is of other scenes than these tables" in text
    assert "seed_protocol" not in json.loads((tmp_path / "results.json").read_text())


def figure(value):
    return Figure(value, value, value, 1)


@pytest.mark.parametrize(
    ("task", "metric", "said"),
    [
        ("T1a relations", "R-precision, distinct classes", True),
        ("T1b completion", "R-precision", True),
        ("T2 missing", "MRR", False),
    ],
)
def test_precision_of_relations_says_what_counts_as_wrong(task, metric, said):
    text = Results("a", (Cell("a", task, "x", metric, figure(0.5), (0.5,)),), ()).markdown()
    assert ("An unlisted relation counts as wrong" in text) is said


def test_contradictions_and_the_first_guess_stand_in_the_tables():
    assert "top-1" in PRIMARY["T2 missing"]
    assert {"mirrored relations, free", "on-top cycles, free"} <= set(PRIMARY["T4 generate"])


@pytest.mark.parametrize("metric", ["mirrored relations, free", "on-top cycles, free"])
def test_fewer_contradictions_are_better(metric):
    assert is_better(metric, Figure(-0.2, -0.3, -0.1, 9))
    assert not is_better(metric, Figure(0.2, 0.1, 0.3, 9))


def test_what_was_asked_is_in_the_results():
    metrics = {"MMD²": Ratio(np.array([0.5]), np.ones(1))}
    outcome = Outcome(metrics, 7, 2, {"bandwidth": 4.0})
    report = SourceReport("x", "", {"T4 generate": outcome, "Density": None})
    (asked,) = summarise({("a", 0): {"x": report}}, "a").to_dict()["asked"]
    assert asked == {
        "row": "a", "seed": 0, "task": "T4 generate", "source": "x", "scenes": 7, "skipped": 2,
        "notes": {"bandwidth": 4.0},
    }  # fmt: skip


def test_remarks_stand_below_the_tables_of_their_task():
    cells = (Cell("a", "T4 generate", "x", "MMD², free", figure(0.1), (0.1,)),)
    asked = (
        Asked("a", 0, "T4 generate", "x", 7, 0, {"bandwidth": 4.5, "drawn scenes": 1200}),
        Asked("a", 0, "T2 missing", "x", 90, 8, {}),
    )
    text = Results("a", cells, (), asked=asked).markdown()
    assert text.endswith(
        "\n\n| | bandwidth | drawn scenes |\n|---|---|---|\n| x | 4.500 | 1,200 |\n"
    )
    assert "could not be scored" not in text


def test_notes_go_by_source_or_by_row_or_by_both():
    def asked(row, source, value):
        return Asked(row, 0, "Density", source, 5, 0, {"log Z, AIS": value})

    def keys(*some):
        (table,) = remarks(some)
        return [line.split(" | ")[0].strip("| ") for line in table.splitlines()[2:]]

    rows = asked("a", "x", 1.5), asked("a", "y", 1.5), asked("b", "x", 2.5), asked("b", "y", 2.5)
    assert keys(*rows) == ["a, seed 0", "b, seed 0"]
    assert keys(asked("a", "x", 1.5), asked("b", "x", 1.5), asked("b", "y", 2.5)) == ["x", "y"]
    assert keys(*rows, asked("b", "z", 3.5)) == [
        "a, seed 0, x", "a, seed 0, y", "b, seed 0, x", "b, seed 0, y", "b, seed 0, z",
    ]  # fmt: skip


def test_skipped_scenes_are_told_by_source():
    asked = [Asked(r, 0, "T2", s, 90, k, {}) for r, s, k in [("a", "x", 8), ("b", "x", 9)]]
    asked.append(Asked("a", 0, "T2", "y", 1200, 0, {}))
    assert remarks(asked) == ["Scenes that could not be scored: x 8–9 of 90."]
