"""Suggestions stand at free places where their placements say."""

from __future__ import annotations

import re

import httpx
import pytest

from tests.browser.driving import OpenBoard

pytestmark = pytest.mark.system


def test_a_suggestion_at_another_place_or_none_says_so(open_board: OpenBoard) -> None:
    far = {"mean": {"x": 9.0, "y": 0.0, "z": 0.5}, "std": dict.fromkeys("xyz", 0.2), "scenes": 9}
    place = {"relation": "on-top", "object": "desk", "probability": 0.9, "offset": far}
    board = open_board()
    board.alter(
        "missing",
        lambda answer: (
            answer | {"missing": [answer["missing"][0] | {"label": "cup", "placements": [place]}]}
        ),
    )
    board.add("laptop")
    assert "drawn at the nearest free place" in board.rows("missing")[0]
    ghost = board.page.locator("#board .ghost").first
    assert "drawn at the nearest free place" in str(ghost.get_attribute("aria-label"))
    far["mean"]["x"] = 0.0
    board.add("lamp")
    assert board.ghosts == ["cup"]
    assert "nearest free place" not in board.rows("missing")[0]
    # Below the desk, there is no free place.
    place["relation"] = "below"
    del place["offset"]
    board.add("mug")
    assert board.ghosts == []
    assert "no free place on the board" in board.rows("missing")[0]
    assert board.column("missing").get_by_role("button", name="Put ").count() == 0


def test_no_suggestion_stands_at_an_outlier(open_board: OpenBoard, api: httpx.Client) -> None:
    board = open_board({"objects": ["bed", "nightstand", "lamp", "toilet"]})
    (toilet,) = [
        one["object"]
        for one in api.post("/outliers", json=board.scene).json()["outliers"]
        if one["is_outlier"]
    ]
    missing = api.post("/missing", json=board.scene | {"top_k": 5}).json()["missing"]
    places = [place for one in missing for place in one["placements"]]
    assert any(place["object"] == toilet and place["probability"] >= 0.25 for place in places)
    assert not any(re.search(rf"{toilet} \d+ %", row) for row in board.rows("missing"))
