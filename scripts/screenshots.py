"""Take screenshots of the web page for the documentation, from a running service.

    python scripts/screenshots.py http://127.0.0.1:8000

The script needs Debian's chromium and the development dependencies. It writes into docs/images.
"""

from __future__ import annotations

import argparse
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Literal

from playwright.sync_api import Browser, Page, ViewportSize, sync_playwright

FOLDER = Path(__file__).resolve().parent.parent / "docs" / "images"
WIDE: ViewportSize = {"width": 1360, "height": 820}
SETTLED = 1500  # milliseconds to wait until all answers are displayed


def bedroom(page: Page) -> None:
    """Show the page in its initial state."""
    page.evaluate("scrollTo(0, 0)")


def wrong(page: Page) -> None:
    page.get_by_role("tab", name="Wrong").click()


def relations(page: Page) -> None:
    page.get_by_label("Example").select_option("A desk")
    page.get_by_role("tab", name="Relations").click()


def imagine(page: Page) -> None:
    page.get_by_role("tab", name="Generate").click()
    page.locator("#generate").get_by_label("Room").select_option("kitchen")
    page.get_by_role("button", name="Generate a scene").click()
    page.locator("#sweep[aria-valuetext='after 50 sweeps']").wait_for()


def two_models(page: Page) -> None:
    other = page.locator("#second option", has_text="indoor-rbm").last.get_attribute("value")
    page.get_by_label("versus").select_option(other)


PICTURES: dict[str, tuple[Callable[[Page], None], Literal["light", "dark"], ViewportSize]] = {
    "board-missing": (bedroom, "light", WIDE),
    "board-wrong": (wrong, "light", WIDE),
    "board-relations": (relations, "light", WIDE),
    "board-imagine": (imagine, "light", WIDE),
    "board-two-models": (two_models, "light", WIDE),
    "board-dark": (bedroom, "dark", WIDE),
    "board-telephone": (bedroom, "light", {"width": 375, "height": 812}),
}


def take(browser: Browser, url: str, name: str) -> Path:
    """Take one screenshot."""
    act, colours, size = PICTURES[name]
    context = browser.new_context(viewport=size, color_scheme=colours, reduced_motion="reduce")
    page = context.new_page()
    page.goto(url)
    page.wait_for_timeout(SETTLED)
    act(page)
    page.wait_for_timeout(SETTLED)
    path = FOLDER / f"{name}.png"
    page.screenshot(path=path)
    context.close()
    return path


def main() -> None:
    """Take all screenshots, or the screenshots named on the command line."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("url", help="URL of a running service")
    parser.add_argument("names", nargs="*", help=f"screenshots, default all: {', '.join(PICTURES)}")
    arguments = parser.parse_args()
    FOLDER.mkdir(exist_ok=True)
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(
            executable_path=shutil.which("chromium"), args=["--headless", "--no-sandbox"]
        )
        for name in arguments.names or PICTURES:
            path = take(browser, arguments.url, name)
            print(f"{path.name}: {path.stat().st_size // 1024} kB")
        browser.close()


if __name__ == "__main__":
    main()
