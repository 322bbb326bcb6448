"""Take screenshots of the web page from a running service.

    python scripts/screenshots.py http://127.0.0.1:8000
    python scripts/screenshots.py http://127.0.0.1:8000 --every build/screenshots

The first command writes the picture of README.md into docs/images. The second one writes pictures
of all states for a desk, a tablet and a phone, light and dark, to look at after a change of the
page. The script needs Debian's chromium and the development dependencies.
"""

from __future__ import annotations

import argparse
import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Final, Literal

from playwright.sync_api import Browser, Page, ViewportSize, sync_playwright

README: Final = Path(__file__).resolve().parent.parent / "docs" / "images" / "board-missing.png"
SIZES: Final[dict[str, ViewportSize]] = {
    "desk": {"width": 1360, "height": 820},
    "tablet": {"width": 820, "height": 1180},
    "phone": {"width": 375, "height": 812},
}
SETTLED: Final = 1500  # milliseconds to wait until all answers are displayed
UNKNOWN: Final = {"objects": ["bed", "fridgee", "flux capacitor"], "room_type": "bedrom"}


def tab(name: str) -> Callable[[Page], None]:
    return lambda page: page.get_by_role("tab", name=name).click()


def generate(page: Page) -> None:
    tab("Generate")(page)
    page.get_by_role("button", name="Generate a scene").click()


def two_models(page: Page) -> None:
    other = page.locator("#second option", has_text="indoor-rbm").last.get_attribute("value")
    page.get_by_label("compare with").select_option(other)


def positions(page: Page) -> None:
    page.get_by_label("Positions count as evidence").check()
    page.locator("#list .name").first.click()
    tab("Relations")(page)


def dialog(page: Page) -> None:
    page.get_by_role("button", name="Import, export").click()


def unknown(page: Page) -> None:
    dialog(page)
    page.get_by_label("Scene, JSON").fill(json.dumps(UNKNOWN))
    page.get_by_role("button", name="Put on the board").click()


def empty(page: Page) -> None:
    page.get_by_role("button", name="Clear").click()


STATES: Final[dict[str, Callable[[Page], None]]] = {
    "missing": tab("Missing"),
    "wrong": tab("Wrong"),
    "relations": tab("Relations"),
    "generate": generate,
    "two-models": two_models,
    "positions": positions,
    "unknown": unknown,
    "dialog": dialog,
    "empty": empty,
}


def take(
    browser: Browser, url: str, state: str, size: str, colours: Literal["light", "dark"], path: Path
) -> None:
    """Take one screenshot."""
    context = browser.new_context(
        viewport=SIZES[size], color_scheme=colours, reduced_motion="reduce"
    )
    page = context.new_page()
    page.goto(url)
    page.wait_for_timeout(SETTLED)
    STATES[state](page)
    page.wait_for_timeout(SETTLED)
    path.parent.mkdir(parents=True, exist_ok=True)
    page.screenshot(path=path)
    context.close()
    print(f"{path}: {path.stat().st_size // 1024} kB")


def main() -> None:
    """Take the picture of README.md, or all pictures."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("url", help="URL of a running service")
    parser.add_argument("--every", type=Path, metavar="FOLDER", help="take all pictures into it")
    arguments = parser.parse_args()
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(
            executable_path=shutil.which("chromium"), args=["--headless", "--no-sandbox"]
        )
        if arguments.every is None:
            take(browser, arguments.url, "missing", "desk", "light", README)
            return
        for state in STATES:
            for size in SIZES:
                for colours in ("light", "dark"):
                    path = arguments.every / f"{state}-{size}-{colours}.png"
                    take(browser, arguments.url, state, size, colours, path)


if __name__ == "__main__":
    main()
