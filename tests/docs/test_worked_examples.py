"""The examples of /docs do on the shipped models what they say, for whoever presses the button."""

from __future__ import annotations

import json
from pathlib import Path
from time import monotonic
from typing import Any

import httpx
import pytest

from app.api.examples import REQUESTS
from tests.docs.blocks import blocks
from tests.docs.conftest import Workplace

pytestmark = pytest.mark.system


@pytest.mark.parametrize("operation", sorted(REQUESTS.keys() - {"move_alias"}))
def test_examples_are_answered_by_the_shipped_models(workplace: Workplace, operation: str) -> None:
    address = f"http://{workplace.address}/{operation.replace('_', '/')}"
    for name, case in REQUESTS[operation].items():
        response = httpx.post(address, json=case.value, timeout=60)
        if case.problem is None:
            assert response.status_code == 200, (name, response.text)
        else:
            assert response.json()["type"] == f"/problems/{case.problem}", (name, response.text)


def test_the_picture_shows_what_the_default_model_answers(
    workplace: Workplace, repository: Path
) -> None:
    picture = (repository / "docs" / "scene.svg").read_text(encoding="utf-8")
    body = {"objects": ["desk", "monitor", "chair", "toilet"]}

    def ask(question: str, entries: str = "") -> Any:
        answer = httpx.post(f"http://{workplace.address}/{question}", json=body).json()
        return answer[entries or question]

    relation, missing, outlier = ask("relations")[0], ask("missing")[0], ask("outliers")[0]
    assert [relation[end] for end in ("subject", "relation", "object")] == [
        *("monitor", "on-top", "desk")
    ]
    assert "the monitor stands on the desk" in picture
    place = missing["placements"][0]
    assert f"a {missing['label']}, {place['relation']} the {place['object']}" in picture
    assert outlier["because"][0]["log_odds_change"] < 0
    assert f">an {ask('rooms', 'room_types')[0]['room_type']}<" in picture
    assert f"the {outlier['object']}, because of the {outlier['because'][0]['object']}" in picture


def test_the_log_line_of_the_operations_page_has_the_fields_of_a_real_one(
    workplace: Workplace, repository: Path
) -> None:
    page = repository / "docs" / "operations.md"
    (shown,) = [json.loads(block.source) for block in blocks(page) if block.language == "json"]
    request_id = "e7a3b2f0-documentation"
    httpx.post(
        f"http://{workplace.address}/missing",
        json={"objects": ["bed"]},
        headers={"X-Request-Id": request_id},
    )
    # Written when the answer has been sent, which the client may see before.
    log, found, deadline = workplace.folder.parent / "log", list[str](), monotonic() + 10
    while not found and monotonic() < deadline:
        found = [line for line in log.read_text("utf-8").splitlines(True) if request_id in line]
        found = [line for line in found if line.endswith("\n")]
    (line,) = map(json.loads, found)
    assert line.keys() == shown.keys()
    assert {name: type(value) for name, value in line.items()} == {
        name: type(value) for name, value in shown.items()
    }
