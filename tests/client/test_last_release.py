"""The Python client of the last release asks the service.

Within one major version, it reads every answer. The folder `last_release` contains the wheel of
that client. docs/contributing.md says how a release renews it.
"""

import json
import os
import sys
from pathlib import Path
from typing import Any

from app import __version__
from tests.conftest import run_program
from tests.services import LiveService

(WHEEL,) = (Path(__file__).parent / "last_release").glob("*.whl")
RELEASED = """
import json, sys
import scene_client

assert ".whl" in scene_client.__file__
with scene_client.Client(sys.argv[1]) as scene:
    for method, arguments in json.load(sys.stdin):
        try:
            answer = getattr(scene, method)(*arguments)
        except scene_client.ClientError as error:
            print(json.dumps(f"{type(error).__name__}: {error}"))
        else:
            print(answer.model_dump_json(exclude_unset=True))
"""
POSED = {"id": "l", "label": "lamp", "position": {"x": 1.0, "y": 0.0, "z": 0.5}}
SCENE = {
    "objects": ["bed", POSED],
    "relations": [{"subject": "l", "relation": "left", "object": "bed"}],
    "room_type": "bedroom",
    "unknown_labels": "nearest",
}
QUESTIONS: list[tuple[str, Any]] = [
    ("/relations", SCENE | {"pairs": [{"subject": "l", "object": "bed"}], "min_probability": 0.1}),
    ("/missing", SCENE | {"coverage": 0.9, "at": {"relation": "on-top", "object": "bed"}}),
    ("/outliers", SCENE | {"sensitivity": "high"}),
    ("/missing/batch", [{"objects": ["bed"]}, {"objects": ["nonsuch"]}]),
]
# The client of the former major version cannot read these answers. docs/upgrading.md names the
# change.
UNREADABLE = [
    ("/generate", {"objects": ["bed"], "seed": 7, "steps": 5}, "`context` of `/generate`"),
    ("/relations", {"objects": ["bed", "nightstand", "lamp"]}, "cannot read `/relations`,"),
    ("/missing", {"objects": ["refrigerator", "stove"]}, "places inside of a thing"),
]


def contains(answer: Any, part: Any) -> bool:
    """Whether the answer has every value of the part, except ids of requests."""
    if isinstance(part, dict):
        names = part.keys() - {"request_id", "instance"}
        return all(name in answer and contains(answer[name], part[name]) for name in names)
    if isinstance(part, list):
        return len(part) == len(answer) and all(map(contains, answer, part))
    return part == answer


def test_the_last_release_reads_the_answers(shipped: LiveService, repository: Path) -> None:
    requests = [*QUESTIONS, *(entry[:2] for entry in UNREADABLE)]
    calls = [(path[1:].replace("/", "_"), [request]) for path, request in requests]
    done = run_program(
        *(sys.executable, "-c", RELEASED, shipped.url),
        env=os.environ | {"PYTHONPATH": str(WHEEL)},
        input=json.dumps([("models", []), *calls]),
    )
    models, *answers = map(json.loads, done.stdout.splitlines())
    assert contains(shipped.client.get("/models").json(), models)
    for (path, request), answer in zip(QUESTIONS, answers, strict=False):
        assert isinstance(answer, dict), answer
        body = {"scenes": request} if isinstance(request, list) else request
        assert contains(shipped.client.post(path, json=body).json(), answer)
    major = WHEEL.name.split("-")[1].split(".")[0]
    assert not UNREADABLE or major != __version__.split(".")[0], "only a major version breaks"
    changes = (repository / "docs" / "upgrading.md").read_text("utf-8")
    for (_, _, change), answer in zip(UNREADABLE, answers[len(QUESTIONS) :], strict=True):
        assert answer.startswith("AnswerError")
        assert change in changes
