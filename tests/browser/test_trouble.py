"""Large scenes, superseded questions, refusals, keys, and a service that goes away."""

from __future__ import annotations

from pathlib import Path

import pytest
from playwright.sync_api import Route, expect

from tests.browser.driving import OpenBoard
from tests.services import launch

pytestmark = pytest.mark.system


@pytest.mark.slow
def test_a_question_that_is_overtaken_is_dropped(open_board: OpenBoard) -> None:
    board = open_board()
    every, failed, held = list[str](), list[str](), list[Route]()
    board.page.on("request", lambda one: every.append(one.url.rpartition("/")[2]))
    board.page.on("requestfailed", lambda one: failed.append(one.url.rpartition("/")[2]))
    board.page.route("**/missing", lambda route: held.append(route))
    board.thing("chair").focus()
    for _ in range(8):
        board.page.keyboard.press("ArrowUp")
    board.page.wait_for_timeout(500)
    asked = every.count("missing")
    assert asked < 8
    board.page.keyboard.press("ArrowUp")
    board.page.wait_for_timeout(500)
    assert every.count("missing") == asked + 1
    assert failed.count("missing") == asked
    held[-1].continue_()
    board.settle()
    assert board.scene["objects"][1]["position"]["x"] == pytest.approx(1.9)
    assert board.rows("missing")


@pytest.mark.slow
def test_a_full_service_is_asked_again_when_it_says(open_board: OpenBoard) -> None:
    board = open_board(allow=("429",))
    refusals = []

    def refuse_once(route: Route) -> None:
        if refusals:
            route.continue_()
            return
        refusals.append(route)
        problem = {"type": "/problems/queue-full", "title": "Queue full", "status": 429}
        problem |= {"detail": "The queue is full.", "request_id": "r"}
        route.fulfill(status=429, json=problem, headers={"Retry-After": "1"})

    board.page.route("**/missing", refuse_once)
    board.add("laptop")
    alert = board.column("missing").get_by_role("alert")
    expect(alert).to_contain_text("The queue is full")
    expect(alert).to_be_hidden(timeout=5000)
    board.settle()
    assert board.rows("missing")


@pytest.mark.slow
def test_the_page_outlives_the_service(
    open_board: OpenBoard, repository: Path, tmp_path: Path
) -> None:
    store = repository / "model_store"
    with launch(store, tmp_path / "log") as mortal:
        board = open_board(home=mortal.url, allow=("ERR_", "503"))
        mortal.process.kill()
        mortal.process.wait()
        board.add("laptop")
        expect(board.page.get_by_role("alert").first).to_contain_text("does not answer")
        assert board.things == ["desk", "chair", "laptop"]
    with launch(store, tmp_path / "log2", port=mortal.port):
        expect(board.page.locator("#banner")).to_be_hidden(timeout=30_000)
        board.settle()
        assert len(board.body("missing")["objects"]) == 3
        assert board.rows("missing")


@pytest.mark.slow
def test_a_service_with_a_key_is_asked_with_it(
    open_board: OpenBoard, repository: Path, tmp_path: Path
) -> None:
    key = "a-key-of-sixteen-letters"
    with launch(repository / "model_store", tmp_path / "log", SCENE_API_KEY=key) as guarded:
        home = f"http://127.0.0.1:{guarded.port}"
        board = open_board(scene=None, home=home, allow=("401",))
        assert board.things == []
        board.page.get_by_label("API key").first.fill(key)
        board.page.get_by_label("API key").first.press("Enter")
        # The page opens with an example as soon as the service answers.
        entries = board.column("missing").locator("ol > li")
        expect(entries).not_to_have_count(0, timeout=20_000)
        assert board.things
        assert '-H "X-API-Key: $SCENE_API_KEY"' in board.curl("missing")
        assert key not in board.page.content()
