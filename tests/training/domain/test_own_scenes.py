"""The walk of `scripts/walk.py`, and the next steps of its user. The scenes are generated: 300 of
laboratories, workshops and storerooms, and those of a home."""

import json
import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

from app.registry import Store
from tests.services import serve
from tests.training.commands import invoke

pytestmark = [pytest.mark.slow, pytest.mark.anyio]

BENCH = ["electronics bench", "soldering irons", "multimeter", "lab stool"]


class Workplace:
    def __init__(self, folder: Path) -> None:
        self.folder, self.store = folder, folder / "my-store"
        self.places = ("--runs", folder / "runs")
        self.run = folder / "runs" / "my-lab" / "seed-0"

    def publish(self, run: Path, version: str, *options: object, code: int = 0) -> str:
        return invoke("publish", run, version, "--store", self.store, *options, code=code)

    def compare(self, *arguments: object) -> dict:
        path = self.folder / "comparison.json"
        invoke("compare", *arguments, "--store", self.store, "--json", path)
        return json.loads(path.read_text())

    @property
    def state(self) -> tuple[str, tuple[str, ...]]:
        store = Store(self.store)
        return str(store.aliases()["default"]), store.versions("my-lab")


@pytest.fixture(scope="module")
def workplace(tmp_path_factory, repository, find_tool) -> Workplace:
    """The folder of a user who took the walk, on a machine without a network."""
    record = tmp_path_factory.mktemp("walk") / "record"
    for tool in ("chromium", "ip"):
        find_tool(tool)
    isolated = [find_tool("unshare"), "--net", *([] if os.geteuid() == 0 else ["-r"])]
    shell = ["sh", "-c", 'ip link set lo up && exec "$@"', "sh"]
    walk = [sys.executable, "scripts/walk.py", record]
    subprocess.run([*isolated, *shell, *walk], cwd=repository, check=True)
    return Workplace(record / "work")


def test_the_walk_is_recorded(workplace) -> None:
    record = (workplace.folder.parent / "walk.md").read_text()
    for words in (
        "300 generated scenes",
        "trained in",
        "refused: the new version is not clearly better than popularity",
        "promoted: default → my-lab@1.1.0, before my-lab@1.0.0",  # an equal version
        "next: SCENE_STORE=my-store SCENE_PORT=8055 python -m app",
        "published home@1.0.0",
    ):
        assert words in record
    for name in re.findall(r"\(([a-z-]+\.png)\)", record):
        assert (workplace.folder.parent / name).stat().st_size > 20_000


def test_the_model_is_accurate(workplace) -> None:
    comparison = workplace.compare(workplace.run, "baselines")
    values = {
        (cell["task"], cell["metric"]): cell["figure"]["value"]
        for cell in comparison["cells"]
        if cell["row"] == comparison["ours"]
    }
    assert values["T2 missing", "MRR, one removed"] > 0.6
    assert values["T3 outliers", "hit@1, uniform"] > 0.8


async def test_the_service_answers_with_the_model(workplace) -> None:
    question = {"objects": BENCH, "top_k": 3}
    async with serve(workplace.store) as client:
        answer = (await client.post("/missing", json=question)).json()
        # The scenes say "storeroom", which the training reads as "storage room".
        in_room = await client.post("/missing", json=question | {"room_type": "storeroom"})
    assert in_room.status_code == 200
    assert answer["model"]["name"] == "my-lab"
    assert answer["ignored"] == []
    assert "oscilloscope" in [entry["label"] for entry in answer["missing"]]
    assert any(entry["placements"] for entry in answer["missing"])


def test_the_card_has_the_stated_terms(workplace) -> None:
    manifest = Store(workplace.store).load("my-lab", "1.0.0").manifest
    (source,) = manifest.data
    assert source.source == "scenes"
    assert source.terms == "Generated; no restriction"
    assert str(workplace.folder) not in manifest.model_dump_json()


def test_a_worse_version_is_refused_without_even_if_worse(workplace) -> None:
    text = (workplace.folder / "my-lab" / "my-lab.toml").read_text()
    hasty = workplace.folder / "my-lab" / "hasty.toml"
    text = re.sub(r"^steps = \d+", "steps = 1", text, flags=re.MULTILINE)
    hasty.write_text(re.sub(r"^epochs = \d+", "epochs = 1", text, flags=re.MULTILINE))
    invoke("train", hasty, "--seed", 1, *workplace.places)
    run = workplace.run.with_name("seed-1")
    before, versions = workplace.state

    # The walk has a refusal for the served alias.
    output = workplace.publish(run, "2.0.0", "--promote", "--alias", "new-alias", code=3)
    assert "the new version is worse than EASE" in output
    assert "nothing was published" in output
    assert workplace.state == (before, versions)

    output = workplace.publish(run, "2.0.0", "--promote", "--even-if-worse")
    assert f"accepted by --even-if-worse: the new version is worse than {before}" in output
    assert f"promoted: default → my-lab@2.0.0, before {before}" in output
    assert workplace.state[0] == "my-lab@2.0.0"


def test_a_run_is_not_published_with_an_edited_vocabulary(workplace) -> None:
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
