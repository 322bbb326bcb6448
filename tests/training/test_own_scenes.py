"""From somebody's scenes of a domain that no shipped model knows to a served model.

The commands are those of docs/training.md. The scenes are generated: 300 of laboratories,
workshops and storerooms.
"""

from __future__ import annotations

import contextlib
import json
import re
import shlex
from pathlib import Path

import pytest
from typer.testing import CliRunner

from app.registry import Store
from tests.services import launch, serve
from training.cli import app

pytestmark = [pytest.mark.slow, pytest.mark.anyio]

GUIDE = Path(__file__).parents[2] / "docs" / "training.md"
BENCH = ["electronics bench", "soldering irons", "multimeter", "lab stool"]


def invoke(*arguments: object, code: int = 0) -> str:
    result = CliRunner().invoke(app, [str(argument) for argument in arguments])
    assert result.exit_code == code, result.output
    return " ".join(result.output.split())


class Workplace:
    """A user's folder, with a trained run in it."""

    def __init__(self, folder: Path) -> None:
        self.folder, self.store = folder, folder / "my-store"
        self.places = ("--runs", folder / "runs")
        self.run = folder / "runs" / "my-lab" / "seed-0"
        self.told: dict[str, str] = {}

    def publish(self, run: Path, version: str, *options: object, code: int = 0) -> str:
        return invoke("publish", run, version, "--store", self.store, *options, code=code)

    def compare(self, *arguments: object) -> tuple[str, dict]:
        path = self.folder / "comparison.json"
        output = invoke("compare", *arguments, "--store", self.store, "--json", path)
        return output, json.loads(path.read_text())

    @property
    def served(self) -> str:
        return str(Store(self.store).aliases()["default"])

    @property
    def versions(self) -> tuple[str, ...]:
        return Store(self.store).versions("my-lab")


@pytest.fixture(scope="module")
def workplace(tmp_path_factory) -> Workplace:
    """What the guide says, command by command."""
    place = Workplace(tmp_path_factory.mktemp("workplace"))
    blocks = re.findall(r"^```sh\n(.*?)^```", GUIDE.read_text(encoding="utf-8"), re.M | re.S)
    lines = [line for block in blocks for line in block.splitlines()]
    commands = [shlex.split(line.removeprefix("python -m training ")) for line in lines]
    assert [command[0] for command in commands] == [
        "example",
        "init",
        "train",
        "compare",
        "publish",
    ]
    with contextlib.chdir(place.folder):
        for command in commands:
            place.told[command[0]] = invoke(*command)
    return place


def test_every_command_says_what_it_did(workplace) -> None:
    told = workplace.told
    assert "300 generated scenes" in told["example"]
    assert "next:" in told["init"]
    assert "best epoch" in told["train"]
    assert "baselines" in told["compare"]
    assert "removed:" in told["compare"]
    assert "default is a new alias" in told["publish"]
    assert "promoted: default → my-lab@1.0.0" in told["publish"]


def test_the_model_is_worth_having(workplace) -> None:
    _, comparison = workplace.compare(workplace.run, "baselines")
    values = {
        (cell["task"], cell["metric"]): cell["figure"]["value"]
        for cell in comparison["cells"]
        if cell["row"] == comparison["ours"]
    }
    assert values["T2 missing", "MRR"] > 0.6
    assert values["T3 outliers, uniform", "hit@1"] > 0.8
    assert comparison["certain"]


async def test_the_service_answers_with_it(workplace) -> None:
    question = {"objects": BENCH, "top_k": 3}
    async with serve(workplace.store) as client:
        answer = (await client.post("/missing", json=question)).json()
    assert answer["model"]["name"] == "my-lab"
    assert answer["ignored"] == []
    assert "oscilloscope" in [entry["label"] for entry in answer["missing"]]
    assert any(entry["placements"] for entry in answer["missing"])
    with launch(workplace.store, workplace.folder / "log") as service:
        assert service.client.post("/missing", json=question).json()["missing"] == answer["missing"]


def test_the_card_has_the_terms_that_were_given(workplace) -> None:
    manifest = Store(workplace.store).load("my-lab", "1.0.0").manifest
    (source,) = manifest.data
    assert source.source == "scenes"
    assert source.terms == "Generated; no restriction"
    assert str(workplace.folder) not in manifest.model_dump_json()


def test_the_same_again_is_not_worse_and_may_take_its_place(workplace) -> None:
    output, comparison = workplace.compare(workplace.run)
    assert comparison["b"].startswith("my-lab@1.0.0")
    assert {row["verdict"] for row in comparison["differences"]} == {"undecided"}
    assert {row["figure"]["value"] for row in comparison["differences"]} == {0.0}
    assert "Questions with the most different answers" not in output
    output = workplace.publish(workplace.run, "1.0.1", "--promote")
    assert "promoted: default → my-lab@1.0.1, before my-lab@1.0.0" in output


def test_a_worse_version_is_refused_unless_somebody_insists(workplace) -> None:
    text = (workplace.folder / "my-lab" / "my-lab.toml").read_text()
    hasty = workplace.folder / "my-lab" / "hasty.toml"
    changed = {
        "epochs": "epochs = 1",
        "updates": "updates = 0",
        "learning_rate": "learning_rate = 1e-6",
    }
    lines = [changed.get(line.partition(" ")[0], line) for line in text.splitlines()]
    hasty.write_text("\n".join(lines))
    invoke("train", hasty, "--seed", 1, *workplace.places)
    run = workplace.run.with_name("seed-1")
    before, versions = workplace.served, workplace.versions

    for alias in ("default", "new-alias"):
        output = workplace.publish(run, "2.0.0", "--promote", "--alias", alias, code=3)
        assert "refused: the new version is not better than popularity" in output
        assert "the new version is worse than EASE" in output
        assert "nothing was published" in output
        assert (workplace.served, workplace.versions) == (before, versions)

    _, comparison = workplace.compare(run, before)
    (missing,) = [
        row["figure"]
        for row in comparison["differences"]
        if (row["task"], row["metric"]) == ("T2 missing", "MRR")
    ]
    assert missing["high"] < -0.02

    output = workplace.publish(run, "2.0.0", "--promote", "--even-if-worse")
    assert f"accepted by --even-if-worse: the new version is worse than {before}" in output
    assert f"promoted: default → my-lab@2.0.0, before {before}" in output
    assert workplace.served == "my-lab@2.0.0"


def test_an_edited_vocabulary_is_no_longer_what_the_run_learnt(workplace) -> None:
    path = workplace.folder / "my-lab" / "vocabulary.json"
    before = path.read_text()
    values = json.loads(before)
    values["objects"][0]["aliases"].append("anything")
    path.write_text(json.dumps(values))
    try:
        output = workplace.publish(workplace.run, "3.0.0", code=1)
        assert "vocabulary or split have changed" in output
    finally:
        path.write_text(before)


def test_a_grown_data_set_is_compared_on_what_the_older_version_never_saw(workplace) -> None:
    """More scenes, a new vocabulary in another order: the older version is asked in its classes."""
    grown = workplace.folder / "grown"
    invoke("example", grown / "scenes.jsonl", "--scenes", 360)
    invoke("init", "my-lab", grown / "scenes.jsonl", "--output", grown / "my-lab")
    config = grown / "my-lab" / "my-lab.toml"
    text = config.read_text()
    lines = ["epochs = 2" if line.startswith("epochs") else line for line in text.splitlines()]
    config.write_text("\n".join(lines))
    invoke("train", config, "--runs", grown / "runs")
    _, comparison = workplace.compare(grown / "runs" / "my-lab" / "seed-0", "my-lab@1.0.0")
    assert comparison["certain"]
    assert comparison["scenes"] > 10
    # Two epochs are no match for the older version, whoever's classes are asked in.
    assert comparison["differences"][0]["verdict"] == "worse"
