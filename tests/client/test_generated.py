"""A client that openapi-python-client generates from the service's own OpenAPI document."""

from __future__ import annotations

import json
import os
import sys
from pathlib import Path

import pytest

from tests.conftest import run_program
from tests.services import LiveService

PROGRAM = """
import json, sys
from generated import Client, models
from generated.api import questions
import generated.api.questions.generate, generated.api.questions.missing
import generated.api.questions.outliers, generated.api.questions.relations
import generated.api.questions.rooms

client = Client(sys.argv[1])
for name, fields in json.loads(sys.argv[2]).items():
    request = getattr(models, name.title() + "Request").from_dict(fields)
    answer = getattr(questions, name).sync(client=client, body=request)
    print(json.dumps([name, answer.to_dict()]))
"""


@pytest.mark.slow
def test_a_generated_client_asks_all_five_questions(live: LiveService, tmp_path: Path) -> None:
    pytest.importorskip("openapi_python_client")
    (tmp_path / "openapi.json").write_bytes(live.client.get("/openapi.json").content)
    # The generator formats its code with ruff.
    path = f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}"
    run_program(
        *(sys.executable, "-m", "openapi_python_client", "generate", "--path", "openapi.json"),
        *("--output-path", "generated", "--meta", "none", "--fail-on-warning"),
        cwd=tmp_path,
        env=os.environ | {"PATH": path},
    )
    run_program(sys.executable, "-m", "compileall", "-q", "generated", cwd=tmp_path)
    lamp = {"label": "lamp", "id": "l", "position": {"x": 1.0, "y": 0.0, "z": 0.5}}
    scene = {"objects": ["bed", lamp], "relations": [["l", "left", "bed"]], "seed": 7}
    requests = dict.fromkeys(("relations", "missing", "outliers", "rooms", "generate"), scene)
    done = run_program(
        *(sys.executable, "-c", PROGRAM, live.url, json.dumps(requests)), cwd=tmp_path
    )
    answers = dict(map(json.loads, done.stdout.splitlines()))
    assert answers.keys() == requests.keys()
    for question, answer in answers.items():
        expected = live.client.post(f"/{question}", json=scene).json()
        assert answer == expected | {"request_id": answer["request_id"]}
