"""Walk through the project as a new user does, and record each step with its output and time.

    python scripts/walk.py FOLDER              with the packages of this Python
    python scripts/walk.py FOLDER --install    from a fresh clone, with `make run`

The walk leads from the first answer and the web page over the user's own scenes to the promotion of
an own model, a refused model and a roll-back. `FOLDER/walk.md` contains the record with
screenshots. The walk ends with an error if a step does not do what the record says. It needs
Debian's chromium and the development dependencies, but no internet.
"""

from __future__ import annotations

import argparse
import json
import os
import random
import re
import shlex
import shutil
import socket
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import httpx
from playwright.sync_api import Browser, Page, sync_playwright

ROOT = Path(__file__).resolve().parent.parent
FOLLOWS = 8.0  # seconds in which a service follows a change of its store
START_TIMEOUT = 900.0
SETTLED = 1200  # milliseconds until the page shows all answers


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
        page.wait_for_timeout(SETTLED)
        page.screenshot(path=self._folder / f"{name}.png")
        self._add(f"\n{words}\n\n![{words}]({name}.png)\n")

    def _add(self, text: str) -> None:
        with self._file.open("a", encoding="utf-8") as file:
            file.write(text)


class Walk:
    """The steps of the walk.

    Args:
        record: record of the steps.
        work: the user's folder.
        browser: the user's browser.
        install: whether the walk installs the project from a fresh clone.
    """

    def __init__(self, record: Record, work: Path, browser: Browser, install: bool) -> None:
        self._record, self._work, self._browser, self._install = record, work, browser, install
        self._environment = os.environ | {"COLUMNS": "80", "TERM": "dumb"}

    def run(self) -> None:
        """Take all steps.

        Raises:
            WalkError: a step failed.
        """
        self.first_answer()
        self.own_model()
        self.own_page()
        self.bad_model()
        self.roll_back()

    # ------------------------------------------------------------------------- the first day

    def first_answer(self) -> None:
        """Start the shipped models, ask the question of the README, and open the page."""
        record = self._record
        record.step("Start the service" + (" from a fresh clone" if self._install else ""))
        with self._service(self._start_command()) as url:
            record.step("Ask the first question")
            answer = self._ask(url, "missing", {"objects": ["bed", "nightstand"], "top_k": 3})
            require("pillow" in [one["label"] for one in answer["missing"]], "no pillow is missing")
            record.step("Mistype a label")
            problem = self._ask(url, "missing", {"objects": ["fridgee", "stove"]}, status=422)
            require("fridge" in json.dumps(problem["errors"]), "the error does not suggest fridge")
            answer = self._ask(
                url, "missing", {"objects": ["fridgee", "stove"], "unknown_labels": "nearest"}
            )
            require(answer["mapped"][0]["class"] == "fridge", "fridgee is not mapped to fridge")
            record.step("Open the page")
            with self._page(url) as page:
                record.picture(page, "first-page", "The page opens with an example")
                require(page.locator("#board .object").count() > 2, "the page shows no scene")
                page.get_by_role("tab", name="Wrong").click()
                record.picture(page, "wrong", "Objects that do not belong to the scene")
                self._import(page, {"objects": ["fridgee", "stove", "sink"]})
                record.picture(page, "typo", "A mistyped label on the page")
                require("fridge" in page.locator("main").inner_text(), "the page hides the typo")

    # ------------------------------------------------------------------------ the second day

    def own_model(self) -> None:
        """Train on 300 scenes of a workplace, and promote the model."""
        self._record.step("Train on 300 own scenes, as docs/training.md describes")
        guide = (ROOT / "docs" / "training.md").read_text("utf-8")
        for block in re.findall(r"^```sh\n(.*?)^```", guide, re.MULTILINE | re.DOTALL):
            for command in block.splitlines():
                self._command(command)
        require(self._served() == "my-lab@1.0.0", "the own model is not promoted")

    def own_page(self) -> None:
        """Open the page with the own model."""
        self._record.step("Open the page with the own model")
        with self._service(["python", "-m", "app"], "my-store") as url, self._page(url) as page:
            self._record.picture(page, "own-model", "The page with the own model")
            require(page.locator("#board .object").count() > 2, "the page shows no scene")
            errors = page.locator("[role=alert]:visible, .error:visible:not(:empty)")
            require(errors.count() == 0, f"the page shows errors: {errors.all_inner_texts()}")

    def bad_model(self) -> None:
        """Train on half of the scenes with shuffled labels; the promotion is refused."""
        self._record.step("Try to promote a useless model")
        shuffle_labels(self._work / "scenes.jsonl", self._work / "shuffled.jsonl")
        self._command("python -m training init useless shuffled.jsonl")
        self._command("python -m training train useless")
        publish = "python -m training publish runs/useless/seed-0 1.0.0 --store my-store --promote"
        refused = self._command(publish, status=3)
        require("refused" in refused, "the refusal gives no reason")
        require(self._served() == "my-lab@1.0.0", "the useless model is promoted")

    def roll_back(self) -> None:
        """Promote a second version, and return to the first version without a restart."""
        self._record.step("Promote a second version, and roll back")
        self._command(
            "python -m training publish runs/my-lab/seed-0 1.1.0 --store my-store --promote"
        )
        require(self._served() == "my-lab@1.1.0", "the second version is not promoted")
        with self._service(["python", "-m", "app"], "my-store") as url:
            self._command("python -m app.registry alias default my-lab@1.0.0 --store my-store")
            time.sleep(FOLLOWS)
            answer = self._ask(url, "missing", {"objects": ["multimeter"], "top_k": 1})
            require(answer["model"]["version"] == "1.0.0", "the first version is not served")

    # --------------------------------------------------------------------------------- tools

    def _start_command(self) -> list[str]:
        if not self._install:
            return ["python", "-m", "app"]
        clone = self._work / "clone"
        self._command(f"git clone --quiet {shlex.quote(str(ROOT))} clone")
        return ["make", "--directory", str(clone), "run"]

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
        self._record.block(command, output, time.monotonic() - started)
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
            process.wait(60)

    def _ask(
        self, url: str, path: str, body: dict[str, Any], *, status: int = 200
    ) -> dict[str, Any]:
        """Send a request as curl does, and return the answer."""
        started = time.monotonic()
        response = httpx.post(f"{url}/{path}", json=body, timeout=30)
        answer: dict[str, Any] = response.json()
        shown = json.dumps(answer, indent=1, ensure_ascii=False)
        seconds = time.monotonic() - started
        self._record.block(f"POST /{path} {json.dumps(body)}", shown, seconds)
        code = response.status_code
        require(code == status, f"/{path} has status {code}: {shown}")
        return answer

    def _served(self) -> str:
        """Return the version that the alias default names in the user's store."""
        aliases = json.loads((self._work / "my-store" / "aliases.json").read_text("utf-8"))
        return "{name}@{version}".format(**aliases["default"])

    @contextmanager
    def _page(self, url: str) -> Iterator[Page]:
        context = self._browser.new_context(viewport={"width": 1360, "height": 820})
        page = context.new_page()
        page.goto(url)
        page.wait_for_timeout(SETTLED)
        try:
            yield page
        finally:
            context.close()

    def _import(self, page: Page, scene: dict[str, Any]) -> None:
        page.get_by_role("button", name=re.compile("Import")).first.click()
        page.get_by_label("Scene, JSON").fill(json.dumps(scene))
        page.get_by_role("button", name="Put on the board").click()


def shuffle_labels(source: Path, target: Path) -> None:
    """Write half of the scenes, with labels that are exchanged between all objects."""
    lines = source.read_text("utf-8").splitlines()
    scenes = [json.loads(line) for line in lines[::2]]
    labels = [thing["label"] for scene in scenes for thing in scene["objects"]]
    random.Random(0).shuffle(labels)
    for scene in scenes:
        for thing in scene["objects"]:
            thing["label"] = labels.pop()
    target.write_text("".join(json.dumps(scene) + "\n" for scene in scenes), "utf-8")


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


def main() -> int:
    """Parse the command line, and walk."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("folder", type=Path, help="folder of the record; must not exist")
    parser.add_argument("--install", action="store_true", help="begin with a fresh clone")
    options = parser.parse_args()
    work = options.folder.resolve() / "work"
    work.mkdir(parents=True)
    record = Record(work.parent)
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(
            executable_path=shutil.which("chromium"), args=["--headless", "--no-sandbox"]
        )
        try:
            Walk(record, work, browser, options.install).run()
        except WalkError as error:
            print(f"error: {error}", file=sys.stderr)
            return 1
        finally:
            browser.close()
    print(f"walked: {work.parent / 'walk.md'}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
