"""Which parts of the board count as evidence: labels, stated relations, and positions on demand."""

from __future__ import annotations

import httpx
import pytest
from playwright.sync_api import expect

from tests.browser.driving import Board, OpenBoard

pytestmark = pytest.mark.system

SWITCH = "Positions count as evidence"


def placed(board: Board) -> list[str]:
    """Objects whose position the request contains."""
    return [thing["id"] for thing in board.scene["objects"] if "position" in thing]


def test_positions_count_only_when_switched_on(open_board: OpenBoard, api: httpx.Client) -> None:
    board = open_board(scene=None)
    says = board.page.locator("#evidence")
    expect(says).to_contain_text("The answers use labels only.")
    assert placed(board) == []
    labels = {"objects": [thing["label"] for thing in board.scene["objects"]]}
    alone = api.post("/missing", json=labels | {"room_type": "bedroom", "top_k": 5}).json()
    rows = [row for row in board.rows("missing") if not row.startswith("another ")]
    assert len(rows) == len(alone["missing"])
    for row, one in zip(rows, alone["missing"], strict=True):
        assert row.startswith(one["label"])
    board.use_positions()
    assert placed(board) == board.things
    expect(says).to_contain_text("positions of 5 of 5 objects")
    assert api.post("/relations", json=board.scene).json()["observed_relations"]


def test_positions_that_the_page_chose_do_not_count(open_board: OpenBoard) -> None:
    board = open_board()
    assert board.page.get_by_label(SWITCH).is_checked()
    board.add("monitor")
    board.page.locator("#board .ghost").first.press("Enter")
    board.settle()
    expect(board.page.locator("#board .object.loose")).to_have_count(2)
    assert placed(board) == ["desk", "chair"]
    board.page.locator("#list .name", has_text="monitor").click()
    expect(board.page.locator("#properties")).to_contain_text("Centre, metres (not given)")
    expect(board.page.locator("#evidence")).to_contain_text("positions of 2 of 4 objects")
    expect(board.page.locator("#list li").nth(2)).to_contain_text("position not given")
    board.press("monitor", "ArrowUp")
    assert placed(board) == ["desk", "chair", "monitor"]
