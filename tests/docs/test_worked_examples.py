"""The examples of /docs do on the shipped models what they say, for whoever presses the button."""

from __future__ import annotations

import json
from pathlib import Path
from time import monotonic

import httpx
import pytest

from tests.docs.blocks import blocks
from tests.docs.conftest import Workplace

pytestmark = pytest.mark.system


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
