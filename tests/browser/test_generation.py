"""Drawn scenes are the service's and are laid out by their relations."""

from __future__ import annotations

from typing import Any

import httpx
import pytest
from playwright.sync_api import expect

from tests.browser.driving import Board, OpenBoard, body_of

pytestmark = pytest.mark.system


def draw(board: Board) -> None:
    board.click("Generate a scene")
    expect(board.page.locator("#draft")).to_be_visible()
    board.settle()


def request(board: Board) -> dict[str, Any]:
    return body_of(board.page.locator("#drawn pre").first.text_content() or "")


@pytest.mark.slow
def test_a_drawn_scene_is_the_service_s_and_can_be_kept(
    open_board: OpenBoard, api: httpx.Client
) -> None:
    board = open_board()
    board.page.locator("#room").select_option("kitchen")
    board.tab("Generate")
    seen = []
    for seed in (1, 2):
        draw(board)
        body = request(board)
        assert (body["seed"], body["room_type"], body["objects"]) == (seed, "kitchen", [])
        (scene,) = api.post("/generate", json=body).json()["scenes"]
        assert board.page.locator("#drawn .chips li").all_text_contents() == scene["objects"]
        shown = board.page.locator("#board .object").all()
        names = {str(one.get_attribute("aria-label")).split(",")[0] for one in shown}
        assert names == set(scene["objects"]) == set(board.things)
        seen.append(board.page.locator("#drawn .chips li").all_text_contents())
    assert seen[0] != seen[1]
    board.click("Keep")
    assert board.things == seen[1]
    assert board.scene["room_type"] == "kitchen"
    # The page placed these objects, so their positions do not count.
    assert not any("position" in thing for thing in board.scene["objects"])
    board.click("Undo")
    assert board.things == ["desk", "chair"]
