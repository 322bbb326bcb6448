"""Drawn scenes are the service's, stop by stop, and are laid out by their relations."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import httpx
import pytest
from playwright.sync_api import Route, expect

from tests.browser.driving import Board, body_of

pytestmark = pytest.mark.system

OpenBoard = Callable[..., Board]


def draw(board: Board, seed: int = 11) -> None:
    form = board.page.locator("#generate")
    form.get_by_label("Seed").fill(str(seed))
    board.page.get_by_role("button", name="Generate a scene").click()
    expect(board.page.get_by_role("slider", name="Sweep")).to_have_attribute(
        "aria-valuetext", "after 50 sweeps", timeout=20_000
    )
    board.settle()


def request(board: Board) -> dict[str, Any]:
    return body_of(board.page.locator("#drawn pre").first.text_content() or "")


def chips(board: Board) -> list[str]:
    return board.page.locator("#drawn .chips").first.locator("li:not(.went)").all_text_contents()


@pytest.mark.slow
def test_each_stop_is_what_the_service_draws_with_so_many_sweeps(
    open_board: OpenBoard, api: httpx.Client
) -> None:
    board = open_board()
    board.tab("Generate")
    board.page.locator("#generate").get_by_label("Room").select_option("kitchen")
    draw(board)
    slider = board.page.get_by_role("slider", name="Sweep")
    for stop, steps in ((10, 50), (0, 1), (3, 4)):
        slider.fill(str(stop))
        board.settle()
        body = request(board)
        assert (body["steps"], body["seed"], body["room_type"]) == (steps, 11, "kitchen")
        (scene,) = api.post("/generate", json=body).json()["scenes"]
        assert chips(board) == scene["objects"]
        shown = board.page.locator("#board .object").all()
        names = {str(one.get_attribute("aria-label")).split(",")[0] for one in shown}
        assert names == set(scene["objects"])


@pytest.mark.slow
def test_a_drawn_scene_can_be_kept_and_reads_as_it_was_drawn(
    open_board: OpenBoard, api: httpx.Client
) -> None:
    board = open_board()
    board.tab("Generate")
    board.page.locator("#generate").get_by_label("Room").select_option("bedroom")
    draw(board)
    (scene,) = api.post("/generate", json=request(board)).json()["scenes"]
    board.page.get_by_role("button", name="Keep this scene").click()
    board.settle()
    assert board.things == scene["objects"]
    assert board.scene["room_type"] == "bedroom"
    seen = api.post("/relations", json=board.scene).json()["observed_relations"]
    stacked = [one for one in scene["relations"] if one["relation"] == "on-top"]
    found = [one for one in stacked if one in seen]
    # What stands on two things at once stands on one of them here.
    assert len(found) >= len({one["subject"] for one in stacked}) * 0.7
    board.page.get_by_role("button", name="Undo").click()
    board.settle()
    assert board.things == ["desk", "chair"]


@pytest.mark.slow
def test_what_is_on_the_board_stays_in_the_drawn_scene(
    open_board: OpenBoard, api: httpx.Client
) -> None:
    board = open_board()
    board.tab("Generate")
    board.page.get_by_label("with the objects on the board").check()
    draw(board)
    assert {"desk", "chair"} <= set(chips(board))
    assert [thing["id"] for thing in request(board)["objects"]] == ["desk", "chair"]
    expect(board.page.locator("#board .object:not(.new)")).to_have_count(2)
    board.page.get_by_role("button", name="Back to my scene").click()
    board.settle()
    expect(board.page.locator("#board .object")).to_have_count(2)


@pytest.mark.slow
def test_contexts_are_named_and_can_be_held_on(open_board: OpenBoard, api: httpx.Client) -> None:
    board = open_board()
    board.tab("Generate")
    board.page.get_by_text("Contexts that stay on").click()
    board.page.get_by_label("Find a context by its objects").fill("toilet")
    boxes = board.page.locator("#units label")
    expect(boxes.first).to_contain_text("h1")
    words = boxes.first.inner_text()
    unit = int(words.split()[-1])
    contexts = api.get("/models/default/contexts").json()["layers"]["h1"]
    assert words.startswith(", ".join(one["label"] for one in contexts[unit]["objects"][:3]))
    boxes.first.locator("input").focus()
    board.page.keyboard.press("Space")
    expect(boxes.first.locator("input")).to_be_checked()
    expect(boxes.first.locator("input")).to_be_focused()
    draw(board)
    body = request(board)
    assert body["context"] == {"h1": [unit]}
    (scene,) = api.post("/generate", json=body).json()["scenes"]
    assert unit in scene["context"]["h1"]
    assert chips(board) == scene["objects"]


@pytest.mark.slow
def test_another_seed_draws_another_scene(open_board: OpenBoard) -> None:
    board = open_board()
    board.tab("Generate")
    draw(board)
    first = chips(board)
    board.page.get_by_role("button", name="Another seed").click()
    board.page.wait_for_timeout(300)
    board.settle()
    assert request(board)["seed"] == 12
    assert chips(board) != first


def test_a_seed_that_is_none_is_refused_by_the_form(open_board: OpenBoard) -> None:
    board = open_board()
    board.tab("Generate")
    board.page.locator("#generate").get_by_label("Seed").fill("")
    board.page.get_by_role("button", name="Generate a scene").click()
    assert board.page.evaluate("document.querySelector('[name=seed]').validity.valueMissing")
    expect(board.page.locator("#draft")).to_be_hidden()


@pytest.mark.slow
@pytest.mark.parametrize("button", ["Back to my scene", "Stop"])
def test_a_drawing_that_runs_can_be_ended(open_board: OpenBoard, button: str) -> None:
    board = open_board()
    board.tab("Generate")
    held: list[Route] = []

    def slow(route: Route) -> None:
        if len(held) < 2:
            held.append(route)
            route.continue_()
        else:
            held.append(route)

    board.page.route("**/generate", slow)
    board.page.get_by_role("button", name="Generate a scene").click()
    expect(board.page.locator("#draft")).to_be_visible()
    expect(board.page.get_by_role("button", name="Stop")).to_be_visible()
    board.page.get_by_role("button", name=button).click()
    expect(board.page.get_by_role("button", name="Stop")).to_be_hidden()
    board.settle()
    asked = len(held)
    board.page.wait_for_timeout(300)
    assert len(held) == asked <= 3
    if button == "Back to my scene":
        expect(board.page.locator("#draft")).to_be_hidden()
        assert board.things == ["desk", "chair"]
