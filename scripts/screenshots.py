"""Take the picture of README.md from a running service, and write it into docs/images.

    python scripts/screenshots.py http://127.0.0.1:8000

The script needs Debian's chromium and the development dependencies.
"""

from __future__ import annotations

import argparse
import shutil
from pathlib import Path
from typing import Final

from playwright.sync_api import sync_playwright

PICTURE: Final = Path(__file__).resolve().parent.parent / "docs" / "images" / "board-missing.png"
SETTLED: Final = 1500  # milliseconds to wait until all answers are displayed


def main() -> None:
    """Take the picture of the answers to `/missing`."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("url", help="URL of a running service")
    url = parser.parse_args().url
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(
            executable_path=shutil.which("chromium"), args=["--headless", "--no-sandbox"]
        )
        page = browser.new_page(
            viewport={"width": 1360, "height": 820}, color_scheme="light", reduced_motion="reduce"
        )
        page.goto(url)
        page.wait_for_timeout(SETTLED)
        page.get_by_role("tab", name="Missing").click()
        page.wait_for_timeout(SETTLED)
        page.screenshot(path=PICTURE)
        browser.close()
    print(f"{PICTURE}: {PICTURE.stat().st_size // 1024} kB")


if __name__ == "__main__":
    main()
