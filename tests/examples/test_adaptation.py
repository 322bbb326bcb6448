"""The examples that adapt a model to a home: the shell program and the notebook."""

import base64
import inspect
import json
import os
import sys
from pathlib import Path
from typing import Any

import pytest

from scene_client import Client
from tests.conftest import REPOSITORY, FindTool, run_program
from tests.services import launch

pytestmark = [
    pytest.mark.slow,
    pytest.mark.system,
    pytest.mark.skipif(
        "record" not in inspect.signature(Client).parameters, reason="the client records no scenes"
    ),
]

NOTEBOOK = REPOSITORY / "examples/a-day-of-a-robot.ipynb"
LARGEST = 300_000  # bytes


def environment() -> dict[str, str]:
    programs = os.pathsep.join([str(Path(sys.executable).parent), os.environ["PATH"]])
    places = os.pathsep.join([str(REPOSITORY), str(REPOSITORY / "clients/python")])
    return os.environ | {"PATH": programs, "PYTHONPATH": places}


def outputs(notebook: Any) -> list[list[str]]:
    cells = [cell for cell in notebook["cells"] if cell["cell_type"] == "code"]
    return [[output["output_type"] for output in cell["outputs"]] for cell in cells]


def test_the_shell_program_adapts_a_model(tmp_path: Path, find_tool: FindTool) -> None:
    bash, home = find_tool("bash"), tmp_path / "home"
    script = REPOSITORY / "examples/adapt.sh"
    done = run_program(bash, script, home, env=environment(), timeout=1800)
    assert "promoted: default → home@1.0.0" in done.stdout
    assert len((home / "scenes.jsonl").read_text("utf-8").splitlines()) == 3
    objects = ["bed", "pillow", "lamp", "bicycle"]
    with launch(home / "store", tmp_path / "log") as service, Client(service.url) as client:
        for model, expected in (("places-triway", ["bicycle"]), ("default", [])):
            answer = client.outliers(objects, room_type="bedroom", model=model, timeout=60)
            assert [thing.label for thing in answer.outliers if thing.is_outlier] == expected


def test_the_notebook_runs_and_contains_its_outputs(tmp_path: Path) -> None:
    stored = json.loads(NOTEBOOK.read_text("utf-8"))
    assert NOTEBOOK.stat().st_size < LARGEST
    target = tmp_path / "executed.ipynb"
    program = REPOSITORY / "scripts/notebook.py"
    run_program(sys.executable, program, NOTEBOOK, target, env=environment(), timeout=1800)
    executed = json.loads(target.read_text("utf-8"))
    assert outputs(executed) == outputs(stored)
    assert sum(kind == "display_data" for cell in outputs(stored) for kind in cell) == 4
    for cell in stored["cells"]:
        for output in cell.get("outputs", []):
            if output["output_type"] == "display_data":
                assert base64.b64decode(output["data"]["image/png"]).startswith(b"\x89PNG")
    last = "".join(executed["cells"][-1]["outputs"][0]["text"])
    assert last.endswith(" before, 0 after\n")
