"""What the user of `scripts/walk.py` does: run commands, start the service, ask it, open its page.

Each action adds its output and its time to the record.
"""

from __future__ import annotations

import json
import os
import re
import shlex
import socket
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import httpx
from playwright.sync_api import Browser, Page

ROOT = Path(__file__).resolve().parent.parent
PATIENCE = 120.0  # seconds after which a wait is a hang
START_TIMEOUT = 900.0
DELAY = 400  # milliseconds; the page asks this long after a change at the latest


BUSY = "article:not([hidden])[aria-busy=true], #drawn[aria-busy=true]"


class WalkError(Exception):
    """A step of the walk failed."""


def require(condition: object, reason: str) -> None:
    """Raise `WalkError` with the reason unless the condition holds."""
    if not condition:
        raise WalkError(reason)


class Record:
    """The record of a walk: `walk.md` and the screenshots beside it.

    Args:
        folder: folder of the record.
    """

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._file = folder / "walk.md"
        self._file.write_text("# A walk through the project\n", "utf-8")
        self._started = time.monotonic()

    def step(self, title: str) -> None:
        """Begin a step."""
        print(f"{time.monotonic() - self._started:6.1f} s  {title}", flush=True)
        self._add(f"\n## {title}\n")

    def block(self, command: str, output: str, seconds: float) -> None:
        """Add a command, its output and its duration."""
        self._add(f"\n```text\n$ {command}\n{output.rstrip()}\n```\n\n{seconds:.1f} s\n")

    def picture(self, page: Page, name: str, words: str) -> None:
        """Add a screenshot of the page."""
        settle(page)
        page.screenshot(path=self._folder / f"{name}.png")
        self._add(f"\n{words}\n\n![{words}]({name}.png)\n")

    def _add(self, text: str) -> None:
        with self._file.open("a", encoding="utf-8") as file:
            file.write(text)


class User:
    """A user with a folder and a browser.

    Args:
        record: record of the steps.
        work: the user's folder.
        browser: the user's browser.
    """

    def __init__(self, record: Record, work: Path, browser: Browser) -> None:
        self._record, self._work, self._browser = record, work, browser
        self._environment = os.environ | {"COLUMNS": "80", "TERM": "dumb"}

    def _command(self, command: str, status: int = 0) -> str:
        """Run a command in the user's folder, and return its output."""
        arguments = shlex.split(command)
        if arguments[0] == "python":
            arguments[0] = sys.executable
        started = time.monotonic()
        done = subprocess.run(
            arguments,
            cwd=self._work,
            env=self._environment | {"PYTHONPATH": _python_path()},
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
            check=False,
        )
        output = done.stdout.replace(f"{self._work}/", "")
        words = command.replace(f"{ROOT}/", "")
        self._record.block(words, output, time.monotonic() - started)
        require(done.returncode == status, f"{command} has status {done.returncode}:\n{output}")
        return output

    @contextmanager
    def _service(self, command: list[str], store: str | None = None) -> Iterator[str]:
        """Run the service; yield its URL when it is ready."""
        port = _free_port()
        variables = {"SCENE_PORT": str(port), "PORT": str(port)}
        if store is not None:
            variables["SCENE_STORE"] = str(self._work / store)
        if command[0] == "python":
            command = [sys.executable, *command[1:]]
            variables["PYTHONPATH"] = _python_path()
        log = self._work / "service.log"
        started = time.monotonic()
        with log.open("w", encoding="utf-8") as file:
            process = subprocess.Popen(
                command,
                cwd=ROOT,
                env=self._environment | variables,
                stdout=file,
                stderr=file,
                start_new_session=True,
            )
        try:
            url = f"http://127.0.0.1:{port}"
            while not _is_ready(url):
                ended = process.poll() is not None
                late = time.monotonic() - started > START_TIMEOUT
                require(not (ended or late), f"the service is not ready:\n{log.read_text('utf-8')}")
                time.sleep(0.1)
            words = " ".join(command).replace(sys.executable, "python").replace(str(ROOT), ".")
            self._record.block(words, log.read_text("utf-8"), time.monotonic() - started)
            yield url
        finally:
            process.terminate()
            process.wait(PATIENCE)

    def _ask(
        self, url: str, path: str, body: dict[str, Any], *, status: int = 200
    ) -> dict[str, Any]:
        """Send a request as curl does, and return the answer."""
        started = time.monotonic()
        response = httpx.post(f"{url}/{path}", json=body, timeout=PATIENCE)
        answer: dict[str, Any] = response.json()
        shown = json.dumps(answer, indent=1, ensure_ascii=False)
        seconds = time.monotonic() - started
        self._record.block(f"POST /{path} {json.dumps(body)}", shown, seconds)
        code = response.status_code
        require(code == status, f"/{path} has status {code}: {shown}")
        return answer

    def _follow(self, url: str, reference: str, label: str) -> None:
        """Ask about an object until the running service answers with a version."""
        started = time.monotonic()
        while True:
            response = httpx.post(f"{url}/missing", json={"objects": [label]}, timeout=PATIENCE)
            seconds = time.monotonic() - started
            require(response.is_success, response.text)
            if "{name}@{version}".format(**response.json()["model"]) == reference:
                break
            require(seconds < PATIENCE, f"{reference} is not served after {PATIENCE:.0f} s")
            time.sleep(0.5)
        self._record.block("POST /missing, until the model changes", reference, seconds)

    def _served(self, store: str = "my-store") -> str:
        """Return the version that the alias default names in a store."""
        aliases = json.loads((self._work / store / "aliases.json").read_text("utf-8"))
        return "{name}@{version}".format(**aliases["default"])

    @contextmanager
    def _page(self, url: str) -> Iterator[Page]:
        context = self._browser.new_context(viewport={"width": 1360, "height": 820})
        page = context.new_page()
        page.set_default_timeout(1000 * PATIENCE)
        page.goto(url)
        settle(page)
        try:
            yield page
        finally:
            context.close()

    def _import(self, page: Page, scene: dict[str, Any]) -> None:
        page.get_by_role("button", name=re.compile("Import")).first.click()
        page.get_by_label("Scene, JSON").fill(json.dumps(scene))
        page.get_by_role("button", name="Put on the board").click()


def settle(page: Page) -> None:
    """Wait until the page has all answers to the last change."""
    page.wait_for_selector("main:not([aria-busy=true])")
    page.wait_for_timeout(DELAY)
    page.wait_for_function(f"!document.querySelector({BUSY!r})")


def _python_path() -> str:
    return os.pathsep.join([str(ROOT), str(ROOT / "clients/python")])


def _free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port: int = probe.getsockname()[1]
        return port


def _is_ready(url: str) -> bool:
    try:
        return httpx.get(f"{url}/health/ready").is_success
    except httpx.TransportError:
        return False
