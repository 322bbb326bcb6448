"""Drawn scenes are the service's and are laid out by their relations."""

from __future__ import annotations

from typing import Any

import httpx
import pytest
from playwright.sync_api import Route, expect

from tests.browser.driving import Board, OpenBoard, body_of

pytestmark = pytest.mark.system


def draw(board: Board) -> None:
    board.click("Generate a scene")
    expect(board.page.locator("#draft")).to_be_visible()
    board.settle()


def request(board: Board) -> dict[str, Any]:
    return body_of(board.page.locator("#drawn pre").first.text_content() or "")


def chips(board: Board) -> list[str]:
    return board.page.locator("#drawn .chips").first.locator("li").all_text_contents()


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
        assert chips(board) == scene["objects"]
        shown = board.page.locator("#board .object").all()
        names = {str(one.get_attribute("aria-label")).split(",")[0] for one in shown}
        assert names == set(scene["objects"]) == set(board.things)
        seen.append(chips(board))
    assert seen[0] != seen[1]
    board.click("Keep")
    assert board.things == seen[1]
    assert board.scene["room_type"] == "kitchen"
    # The page placed these objects, so their positions do not count.
    assert not any("position" in thing for thing in board.scene["objects"])
    board.click("Undo")
    assert board.things == ["desk", "chair"]


@pytest.mark.slow
def test_objects_of_the_board_stay_in_the_drawn_scene(
    open_board: OpenBoard, api: httpx.Client
) -> None:
    board = open_board()
    board.tab("Generate")
    board.page.get_by_label("with the objects on the board").check()
    draw(board)
    assert {"desk", "chair"} <= set(chips(board))
    assert [thing["id"] for thing in request(board)["objects"]] == ["desk", "chair"]
    expect(board.page.locator("#board .object:not(.new)")).to_have_count(2)
    board.click("Discard")
    expect(board.page.locator("#board .object")).to_have_count(2)


def test_a_drawing_that_runs_ends_with_its_tab(open_board: OpenBoard) -> None:
    board = open_board()
    board.tab("Generate")
    held: list[Route] = []
    board.page.route("**/generate", lambda route: held.append(route))
    board.page.get_by_role("button", name="Generate a scene").click()
    expect(board.page.locator("#drawn")).to_have_attribute("aria-busy", "true")
    board.tab("Missing")
    expect(board.page.locator("#draft")).to_be_hidden()
    assert board.things == ["desk", "chair"]
    assert len(held) == 1
