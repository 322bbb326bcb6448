"""The visual page in a browser, before a running service with the shipped models."""

import json
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import httpx
import pytest
from playwright.sync_api import Browser, Page, Route, expect, sync_playwright

from tests.browser.driving import Board, link_to
from tests.conftest import REPOSITORY, FindTool
from tests.services import PATIENCE, LiveService

expect.set_options(timeout=1000 * PATIENCE)

DESK = {
    "objects": [
        {"id": "desk", "label": "desk", "position": [2, 0, 0.37], "size": [0.8, 1.6, 0.74]},
        {"id": "chair", "label": "chair", "position": [1, 0, 0.45], "size": [0.5, 0.5, 0.9]},
    ]
}

EXAMPLES = json.loads((REPOSITORY / "training/runs/examples/indoor.json").read_text("utf-8"))
"""Example scenes of the shipped vocabulary."""

WITNESS = Path(__file__).parent / "witness.js"
"""A script in each page: `violations` of the policy, and `quiet`, which waits for short timers."""


@pytest.fixture(scope="package")
def chromium(find_tool: FindTool) -> Iterator[Browser]:
    """One browser for all tests of this folder; its event loop must not outlive them."""
    program = find_tool("chromium")
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(
            executable_path=str(program), args=["--headless", "--no-sandbox"]
        )
        yield browser
        browser.close()


@pytest.fixture
def api(shipped: LiveService) -> httpx.Client:
    """The same service, asked without a browser."""
    return shipped.client


@pytest.fixture
def open_board(chromium: Browser, shipped: LiveService) -> Iterator[Callable[..., Board]]:
    """Return a function that opens the page; what must never happen there fails the test."""
    opened: list[tuple[Page, list[str]]] = []

    def open_page(
        scene: dict[str, Any] | None = DESK,
        *,
        examples: list[dict[str, Any]] | None = EXAMPLES,
        allow: tuple[str, ...] = (),
        home: str | None = None,
        url: str | None = None,
        **options: Any,
    ) -> Board:
        context = chromium.new_context(viewport={"width": 1300, "height": 900}, **options)
        context.set_default_timeout(1000 * PATIENCE)
        context.add_init_script(path=WITNESS)
        root = home or str(shipped.client.base_url)
        wrong: list[str] = []

        def only_home(route: Route) -> None:
            address = route.request.url
            if address.startswith((root, "data:", "blob:")):
                route.continue_()
            else:
                wrong.append(f"asked for {address}")
                route.abort()

        def with_examples(route: Route) -> None:
            response = route.fetch()
            route.fulfill(response=response, json=response.json() | {"examples": examples})

        context.route("**/*", only_home)
        if examples is not None:
            context.route("**/vocabulary", with_examples)
        page = context.new_page()
        page.on("pageerror", lambda error: wrong.append(f"error: {error}"))
        page.on(
            "console",
            lambda message: (
                wrong.append(f"console: {message.text}")
                if message.type in {"error", "warning"}
                and not any(text in message.text for text in allow)
                else None
            ),
        )
        opened.append((page, wrong))
        page.goto(url or root + "/" + (link_to(scene) if scene else ""))
        board = Board(page)
        board.settle()
        return board

    yield open_page
    for page, wrong in opened:
        found = [*wrong, *page.evaluate("window.violations")]
        page.unroute_all(behavior="ignoreErrors")  # a test may leave requests without an answer
        page.context.unroute_all(behavior="ignoreErrors")
        page.context.close()
        assert found == []


@pytest.fixture
def board(open_board: Callable[..., Board]) -> Board:
    """The page with a desk and a chair."""
    return open_board()
