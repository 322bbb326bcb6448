"""The ablate command end to end on generated rooms: what it trains, compares and resumes."""

from __future__ import annotations

import json

import pytest

from tests.training.commands import invoke, small_config, write_config
from training.fit.relations import RelationFit
from training.research.ablate import PRIMARY
from training.runs.folder import load_run

pytestmark = pytest.mark.slow

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


def arguments(folder, *, rows=ROWS):
    path = folder / "rows.toml"
    path.write_text(rows)
    config = write_config(folder / "config.toml", small_config())
    # In this process, where tests can look on.
    where = ("--rows", path, "--folder", folder / "ablation", "--length", "0.5", "--workers", "1")
    return "ablate", config, *where


@pytest.fixture(scope="module")
def finished(tmp_path_factory):
    """The folder of a finished ablation, most of it made by two workers."""
    folder = tmp_path_factory.mktemp("ablation")
    invoke(*arguments(folder), "--workers", "2")
    return folder


def results(folder):
    return json.loads((folder / "ablation/rooms-triway/results.json").read_text())


def test_every_row_is_compared_with_the_full_model_on_both_parts(finished):
    found = results(finished)
    assert found["ours"] == "rooms-triway"
    cells = {
        (cell["row"], cell["source"], cell["task"], cell["metric"]): cell["figure"]["value"]
        for cell in found["cells"]
    }
    sources = {f"{part} {name}" for part in ("validation", "test") for name in ("rooms", "pooled")}
    rows = {"rooms-triway", "wide", "no-counts"}
    # Some parts hold no pair that training tells little of, and no class typical of a room.
    little = ("accuracy, unseen pairs", "accuracy, rare classes", "hit@1, signature")
    metrics = {
        (task, name) for task, names in PRIMARY.items() for name in names if name not in little
    }
    cells = {key: value for key, value in cells.items() if key[-1] not in little}
    assert set(cells) == {(r, s, *m) for r in rows for s in sources for m in metrics}
    for gap in found["differences"]:
        key = (gap["source"], gap["task"], gap["metric"])
        if gap["metric"] in little:
            continue
        assert gap["figure"]["value"] == pytest.approx(
            cells["rooms-triway", *key] - cells[gap["row"], *key]
        )


def test_a_row_that_diverges_is_reported_and_left_out(finished):
    failures = results(finished)["failures"]
    assert list(failures) == ["diverging"]
    assert failures["diverging"].startswith("seed 0: ")
    assert "- diverging could not be measured: seed 0" in markdown(finished)


def markdown(folder):
    return (folder / "ablation/rooms-triway/results.md").read_text()


def test_the_table_has_the_row_minus_the_full_model(finished):
    text = markdown(finished)
    assert "An unlisted relation counts as wrong." in text
    section = text[text.index("### T2 missing: MRR, one removed") :]
    assert "interval of the row minus rooms-triway" in section
    header, _, *lines = section.split("\n\n")[2].splitlines()
    columns = [column.strip() for column in header.split("|")]
    parts = ["validation pooled", "test pooled", "validation rooms", "test rooms"]
    assert columns[2:-1] == ["weights", *parts]
    rows = [line.split(" |")[0].strip("| ") for line in lines]
    assert rows == ["**rooms-triway**", "wide", "no-counts"]
    gap = next(
        d["figure"]
        for d in results(finished)["differences"]
        if (d["row"], d["source"], d["task"]) == ("wide", "test pooled", "T2 missing")
    )
    (shown,) = [
        line.split("|")[columns.index("test pooled")] for line in lines if line.startswith("| wide")
    ]
    low, high = (float(bound) for bound in shown.partition("(")[2].rstrip(") ").split(", "))
    assert (low, high) == pytest.approx((-gap["high"], -gap["low"]), abs=6e-4)


def test_costs_count_trained_weights_alone(finished):
    run = load_run(finished / "ablation/rooms-triway/no-counts/seed-0/run")
    assert not run.machine.n.any()
    trained = run.machine.parameter_count - run.machine.n.numel()
    assert results(finished)["parameters"]["no-counts"] == trained
    assert f"| no-counts | {trained:,} | " in markdown(finished)
    assert "| no-counts | instances are not counted | " in markdown(finished)


def test_an_interrupted_ablation_goes_on(finished, tmp_path, monkeypatch):
    epoch, widths = RelationFit.epoch, []

    def interrupted(self, progress):
        widths.append(self.machine.spec.units)
        if len(widths) == 2:
            raise KeyboardInterrupt
        return epoch(self, progress)

    chosen = ("--row", "wide")
    monkeypatch.setattr(RelationFit, "epoch", interrupted)
    assert "to continue" in invoke(*arguments(tmp_path), *chosen, code=130)
    invoke(*arguments(tmp_path), *chosen)
    assert widths == [3, 12, 12]
    first, again = (
        [cell for cell in results(folder)["cells"] if cell["row"] == "wide"]
        for folder in (finished, tmp_path)
    )
    assert again == first


def test_bad_requests_are_named(finished, tmp_path):
    _, config, *_ = arguments(tmp_path)
    for request, message in (
        ((*arguments(tmp_path), "--row", "nobody"), "unknown rows ['nobody']: choose from wide"),
        ((*arguments(tmp_path), "--rows", "nowhere.toml"), "nowhere.toml does not exist"),
        (("ablate", config), "no shipped ablations"),
        ((*arguments(finished), "--limit", "20"), "another configuration of rooms-triway"),
    ):
        assert message in invoke(*request, code=1)
    assert not (tmp_path / "ablation").exists()
