"""Actions of a person on the page, and the content of the page."""

import base64
import json
import re
import shlex
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

from playwright.sync_api import Locator, Page, Route, expect


class Board:
    """The page, used by roles, names and texts, as people do."""

    def __init__(self, page: Page) -> None:
        self.page = page

    def settle(self) -> None:
        """Wait for the answers to all changes."""
        expect(self.page.locator("main[aria-busy=true], #import:disabled")).to_have_count(0)
        self.page.evaluate("window.quiet()")
        self.frame()  # The page draws a change in the next frame, also that it asks.
        busy = self.page.locator("article:not([hidden])[aria-busy=true], #drawn[aria-busy=true]")
        expect(busy).to_have_count(0)
        self.frame()

    def frame(self) -> None:
        """Wait until the page has drawn its next frame."""
        self.page.evaluate("() => new Promise((done) => requestAnimationFrame(() => done()))")

    # ------------------------------------------------------------------------------ doing

    def click(self, button: str) -> None:
        self.page.get_by_role("button", name=button).click()
        self.settle()

    def press(self, thing: str, *keys: str) -> None:
        self.thing(thing).focus()
        for key in keys:
            self.page.keyboard.press(key)
        self.settle()

    def put(self, text: str) -> None:
        self.click("Import, export")
        self.page.get_by_label("Scene, JSON").fill(text)
        self.click("Put on the board")

    def open_file(self, path: Path) -> None:
        self.click("Import, export")
        self.page.get_by_label("Open a file").set_input_files(path)

    def exported(self) -> dict[str, Any]:
        self.click("Import, export")
        scene: dict[str, Any] = json.loads(self.page.get_by_label("Scene, JSON").input_value())
        self.click("Close")
        return scene

    def use_positions(self) -> None:
        self.page.get_by_label("Positions count as evidence").check()
        self.settle()

    def alter(self, question: str, change: Callable[[Any], Any]) -> None:
        def altered(route: Route) -> None:
            response = route.fetch()
            route.fulfill(response=response, json=change(response.json()))

        self.page.route(f"**/{question}", altered)

    def add(self, text: str) -> None:
        """Search for an object and take the first that fits."""
        box = self.page.get_by_role("combobox", name="Add an object")
        box.fill(text)
        box.press("Enter")
        self.settle()

    def tab(self, name: str) -> None:
        self.page.get_by_role("tab", name=name).click()
        self.settle()

    # ---------------------------------------------------------------------------- seeing

    def thing(self, name: str) -> Locator:
        return self.page.locator(f'#board .object[aria-label^="{name},"]')

    @property
    def things(self) -> list[str]:
        return self.page.locator("#list .name b").all_text_contents()

    @property
    def ghosts(self) -> list[str]:
        """The suggestions on the board, also those without room for their name."""
        every = self.page.locator("#board .ghost").all()
        spoken = [ghost.get_attribute("aria-label") or "" for ghost in every]
        return [words.removeprefix("Suggested: ").split(", ")[0] for words in spoken]

    @property
    def edges(self) -> list[tuple[str, str]]:
        """Kind and words of each edge."""
        return [
            (edge.get_attribute("class") or "", plain(edge.locator("text").text_content()))
            for edge in self.page.locator("#board .edges > g").all()
        ]

    @property
    def announced(self) -> str:
        return plain(self.page.locator("#live").text_content())

    def column(self, question: str) -> Locator:
        """The answers of the first model to a question."""
        return self.page.locator(f"[data-question={question}] article").first

    def rows(self, question: str) -> list[str]:
        """The entries of an answer, each in one line, also those in folds, which it opens."""
        answers = self.column(question)
        answers.locator("ol details").evaluate_all("all => all.forEach((one) => (one.open = true))")
        texts = answers.locator("ol > li:not(.group, .fold)").all_inner_texts()
        return [plain(text) for text in texts]

    @property
    def groups(self) -> dict[str, list[str]]:
        """The headings of the tab "Wrong", and the visible entries below each."""
        every = self.column("outliers").locator("li.group").all()
        visible = "li:visible:not(.fold)"
        return {
            plain(one.locator("h3").text_content()): [
                plain(text) for text in one.locator(visible).all_inner_texts()
            ]
            for one in every
        }

    def curl(self, question: str) -> str:
        return self.column(question).locator("pre").first.text_content() or ""

    def python(self, question: str) -> str:
        return self.column(question).locator("pre").nth(1).text_content() or ""

    @property
    def scene(self) -> dict[str, Any]:
        """The scene in the command of the shown question."""
        shown = self.page.locator("article:visible pre").first.text_content() or ""
        fields = ("objects", "relations", "room_type", "frame_id", "viewpoint")
        return {name: value for name, value in body_of(shown).items() if name in fields}

    def body(self, question: str) -> dict[str, Any]:
        """The request of that command."""
        return body_of(self.curl(question))


OpenBoard = Callable[..., Board]


def link_to(scene: dict[str, Any]) -> str:
    packer = zlib.compressobj(wbits=-15)
    packed = packer.compress(json.dumps(scene).encode()) + packer.flush()
    return "#scene=" + base64.urlsafe_b64encode(packed).decode().rstrip("=")


def body_of(command: str) -> dict[str, Any]:
    words = shlex.split(command)
    return json.loads(words[words.index("-d") + 1])


def plain(text: str | None) -> str:
    """A text in one line, with usual blanks."""
    return re.sub(r"\s+", " ", text or "").strip()


def percent(probability: float) -> str:
    if 0 < probability < 0.01:
        return "< 1 %"
    return f"{int(100 * probability + 0.5)} %"
