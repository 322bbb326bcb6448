"""The documentation's site: builds without a warning, and needs nothing from elsewhere."""

import os
import re
import sys
from collections.abc import Iterator
from http.server import SimpleHTTPRequestHandler
from pathlib import Path

import pytest
from playwright.sync_api import sync_playwright

from scripts.site import DIRECTIVE, checks
from tests.conftest import REPOSITORY, FindTool, run_program
from tests.services import http_server

pytestmark = pytest.mark.slow

DOCS = REPOSITORY / "docs"
MODELS = DOCS / "models.md"
CODE = re.compile(r"<(code|pre|script|style|math)\b.*?</\1>", re.DOTALL)


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("site")
    command = (sys.executable, "-m", "mkdocs", "build", "--strict", "--site-dir", folder)
    done = run_program(*command, env=os.environ | {"NO_MKDOCS_2_WARNING": "1"})
    assert "WARNING" not in done.stderr
    return folder


@pytest.fixture(scope="module")
def pages(site: Path) -> dict[str, str]:
    paths = sorted(site.rglob("*.html"))
    return {path.relative_to(site).as_posix(): path.read_text(encoding="utf-8") for path in paths}


def test_every_formula_is_drawn(pages: dict[str, str]) -> None:
    assert pages["models.html"].count("<math") > 50
    for name, page in pages.items():
        for formula in re.findall(r"<math\b.*?</math>", page, re.DOTALL):
            words = re.sub(r"<[^>]*>", "", formula)
            assert words.strip(), name
            assert "\\" not in words, (name, words)  # a command that the converter leaves
        left = re.search(
            r"\$\$|\\\(|\\\[|\$[^$\s][^$]*\$", re.sub(r"<[^>]*>", " ", CODE.sub("", page))
        )
        assert left is None or name == "changelog.html", (name, left)


def test_every_formula_of_the_models_stands_beside_its_code_and_its_tests() -> None:
    text = MODELS.read_text(encoding="utf-8")
    displays = list(re.finditer(r"^\$\$\n.*?^\$\$\n", text, re.DOTALL | re.MULTILINE))
    directives = list(DIRECTIVE.finditer(text))
    assert len(displays) > 15
    for number, formula in enumerate(displays):
        end = displays[number + 1].start() if number + 1 < len(displays) else len(text)
        beside = [d for d in directives if formula.end() <= d.start() < end]
        assert beside, f"no code beside {formula[0]}"
        assert any(checks(directive) for directive in beside), f"no test beside {formula[0]}"


def test_every_test_that_a_formula_names_exists() -> None:
    named = [check for d in DIRECTIVE.finditer(MODELS.read_text("utf-8")) for check in checks(d)]
    for path, test in named:
        source = (REPOSITORY / path).read_text(encoding="utf-8")
        assert re.search(rf"^(async )?def {test}\(", source, re.MULTILINE), f"{path}::{test}"


@pytest.fixture
def served(site: Path) -> Iterator[str]:
    with http_server(SimpleHTTPRequestHandler, directory=site) as url:
        yield url


@pytest.mark.system
def test_the_browser_shows_the_site(served: str, find_tool: FindTool) -> None:
    chromium = find_tool("chromium")
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(
            executable_path=str(chromium), args=["--no-sandbox", "--disable-dev-shm-usage"]
        )
        page = browser.new_page()
        asked: list[str] = []
        errors: list[str] = []
        page.on("request", lambda request: asked.append(request.url))
        page.on("pageerror", lambda error: errors.append(str(error)))
        for name in ("index.html", "models.html", "decisions/README.html"):
            page.goto(f"{served}/{name}", wait_until="networkidle")
        page.goto(f"{served}/models.html", wait_until="networkidle")
        formula = page.locator("math[display=block]").first.bounding_box()
        assert formula is not None
        assert formula["height"] > 10
        page.locator(".md-search__input").click()
        page.keyboard.type("free energy")
        page.locator(".md-search-result__item").first.wait_for()
        browser.close()
    assert errors == []
    assert [url for url in asked if not url.startswith((served, "data:", "blob:"))] == []
