"""The documentation's site: builds without a warning, and needs nothing from elsewhere."""

from __future__ import annotations

import os
import re
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from functools import partial
from html.parser import HTMLParser
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from urllib.parse import unquote, urldefrag, urljoin, urlsplit

import pytest
from playwright.sync_api import sync_playwright

from scripts.site import DIRECTIVE, SOURCES, checks
from tests.conftest import REPOSITORY
from tests.docs.conftest import Workplace

pytestmark = pytest.mark.slow

DOCS = REPOSITORY / "docs"
MODELS = DOCS / "models.md"
_LOADS = {("script", "src"), ("img", "src"), ("iframe", "src"), ("source", "src"), ("link", "href")}


@dataclass
class Looked:
    """What one page of the site refers to, and what others may point at in it."""

    assets: list[str] = field(default_factory=list)
    links: list[str] = field(default_factory=list)
    navigation: list[str] = field(default_factory=list)
    names: set[str] = field(default_factory=set)
    formulas: list[str] = field(default_factory=list)
    text: list[str] = field(default_factory=list)


class Reader(HTMLParser):
    """Reads a page into a `Looked`."""

    def __init__(self) -> None:
        super().__init__()
        self.seen = Looked()
        self._open: list[str] = []
        self._navigation = 0

    def handle_starttag(self, tag: str, attributes: list[tuple[str, str | None]]) -> None:
        known = dict(attributes)
        for name in ("id", "name"):
            if value := known.get(name):
                self.seen.names.add(value)
        for name in ("src", "href"):
            if (tag, name) in _LOADS and (value := known.get(name)):
                self.seen.assets.append(value)
        if tag == "a" and (target := known.get("href")):
            self.seen.links.append(target)
            if self._navigation:
                self.seen.navigation.append(target)
        if tag == "nav" and "md-nav--primary" in (known.get("class") or ""):
            self._navigation = 1
        elif tag == "nav" and self._navigation:
            self._navigation += 1
        if tag == "math":
            self.seen.formulas.append("")
        if tag not in {"br", "hr", "img", "input", "link", "meta", "source"}:
            self._open.append(tag)

    def handle_endtag(self, tag: str) -> None:
        if tag == "nav" and self._navigation:
            self._navigation -= 1
        while self._open and self._open.pop() != tag:
            pass

    def handle_data(self, data: str) -> None:
        if "math" in self._open:
            self.seen.formulas[-1] += data
        elif not {"code", "pre", "script", "style"} & set(self._open):
            self.seen.text.append(data)


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The site, built as `make docs` does it."""
    folder = tmp_path_factory.mktemp("site")
    done = subprocess.run(
        [sys.executable, "-m", "mkdocs", "build", "--strict", "--site-dir", str(folder)],
        cwd=REPOSITORY,
        env=os.environ | {"NO_MKDOCS_2_WARNING": "1"},
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    assert "WARNING" not in done.stderr
    return folder


@pytest.fixture(scope="module")
def pages(site: Path) -> dict[str, Looked]:
    """Every page by its address in the site."""
    found = {}
    for path in sorted(site.rglob("*.html")):
        reader = Reader()
        reader.feed(path.read_text(encoding="utf-8"))
        found[path.relative_to(site).as_posix()] = reader.seen
    assert len(found) > 20
    return found


def test_nothing_is_loaded_from_elsewhere(site: Path, pages: dict[str, Looked]) -> None:
    for name, page in pages.items():
        for asset in page.assets:
            parts = urlsplit(asset)
            assert not parts.netloc, (name, asset)
            if name != "404.html":  # which is served at any address: its paths begin at the root
                assert (site / name).parent.joinpath(parts.path).is_file(), (name, asset)
    for style in site.rglob("*.css"):
        text = style.read_text(encoding="utf-8")
        assert not re.search(r"(url\(|@import)\s*['\"]?(https?:)?//", text), style


def test_every_link_within_the_site_leads_somewhere(site: Path, pages: dict[str, Looked]) -> None:
    followed = 0
    for name, page in pages.items():
        if name == "404.html":
            continue
        for link in page.links:
            if urlsplit(link).scheme:
                continue
            target, anchor = urldefrag(urljoin(f"/{name}", link))
            target = unquote(target.lstrip("/")) or "index.html"
            if target.endswith("/"):
                target += "index.html"
            assert (site / target).is_file(), (name, link)
            if anchor and target in pages:
                assert unquote(anchor) in pages[target].names, (name, link)
            followed += 1
    assert followed > 500


def test_every_page_can_be_reached(pages: dict[str, Looked]) -> None:
    in_navigation = {urldefrag(link)[0] for link in pages["index.html"].navigation}
    linked = {
        urljoin(f"/{name}", urldefrag(link)[0]).lstrip("/")
        for name, page in pages.items()
        for link in page.links
    }
    for name in pages.keys() - {"404.html", "index.html"}:
        assert name in (linked if name.startswith(f"{SOURCES}/") else in_navigation), name


def test_every_formula_is_drawn(pages: dict[str, Looked]) -> None:
    assert len(pages["models.html"].formulas) > 50
    for name, page in pages.items():
        for formula in page.formulas:
            assert formula.strip(), name
            assert "\\" not in formula, (name, formula)  # a command that the converter leaves
        left = re.search(r"\$\$|\\\(|\\\[|\$[^$\s][^$]*\$", " ".join(page.text))
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


@pytest.mark.system
def test_one_command_builds_it(workplace: Workplace) -> None:
    done = subprocess.run(
        ["make", "docs"],
        cwd=workplace.folder,
        env=workplace.environment,
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    assert (workplace.folder / "build" / "site" / "index.html").is_file()


@pytest.fixture
def served(site: Path) -> Iterator[str]:
    """The address of a server of the built files."""

    class Quiet(SimpleHTTPRequestHandler):
        def log_message(self, *arguments: object) -> None:
            pass

    server = ThreadingHTTPServer(("127.0.0.1", 0), partial(Quiet, directory=site))
    thread = threading.Thread(target=server.serve_forever)
    thread.start()
    yield f"http://127.0.0.1:{server.server_address[1]}"
    server.shutdown()
    thread.join()
    server.server_close()


@pytest.mark.system
def test_a_browser_asks_nobody_else_and_sees_the_formulas(
    served: str, require_system_tool: Callable[[str], Path]
) -> None:
    chromium = require_system_tool("chromium")
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
