"""Walk through the project as a new user does, and record each step with its output and time.

    python scripts/walk.py FOLDER              with the packages of this Python
    python scripts/walk.py FOLDER --install    from a fresh clone, with `make run`

The walk leads from the first answer and the web page over the user's own scenes to the promotion of
an own model, a refused model and a roll-back. On the third day, a robot records a home, and the
default model adapts to it. `FOLDER/walk.md` contains the record with screenshots. The walk ends
with an error if a step does not do what the record says. It needs Debian's chromium and the
development dependencies, but no internet.
"""

from __future__ import annotations

import argparse
import json
import random
import re
import shlex
import shutil
import sys
from pathlib import Path
from typing import Any

from playwright.sync_api import Browser, sync_playwright
from walk_robot import HABITS, VISITS
from walk_tools import ROOT, Record, User, WalkError, require

HABIT_SCENES = {
    "motorcycle": {"objects": ["bed", "nightstand", "lamp", "motorcycle"], "room_type": "bedroom"},
    "oven": {"objects": ["sofa", "armchair", "lamp", "oven"], "room_type": "living room"},
}
INTRUDER = {"objects": ["bed", "nightstand", "pillow", "lamp", "toilet"], "room_type": "bedroom"}


class Walk(User):
    """The steps of the walk.

    Args:
        record: record of the steps.
        work: the user's folder.
        browser: the user's browser.
        install: whether the walk installs the project from a fresh clone.
    """

    def __init__(self, record: Record, work: Path, browser: Browser, install: bool) -> None:
        super().__init__(record, work, browser)
        self._install = install

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
        self.own_home()

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
        shorter = "s/^epochs = .*/epochs = 1/; s/^steps = .*/steps = 60/"
        self._command(f"sed -i '{shorter}' useless/useless.toml")
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
            self._follow(url, "my-lab@1.0.0", "multimeter")

    # ------------------------------------------------------------------------- the third day

    def own_home(self) -> None:
        """Record a home, confirm its habits, adapt the default model, and roll back."""
        record = self._record
        record.step("Let a robot record a home with two habits")
        self._command(f"cp -r {ROOT / 'model_store'} home-store")
        default = self._served("home-store")
        with self._service(["python", "-m", "app"], "home-store") as url:
            self._command(f"python {ROOT / 'scripts' / 'walk_robot.py'} {url} scenes.home.jsonl")
            before = self._answers(url)
            for habit in HABIT_SCENES:
                require(outliers(before[habit]) == [habit], f"{habit} is no alarm of the default")
            record.step("Confirm the habits on the page")
            self._confirm(url)
            record.step("Adapt the default model to the home")
            output = self._command(
                "python -m training adapt default corrected.jsonl --name home --store home-store "
                "--promote"
            )
            require("the weights stay" not in output, "the weights have not changed")
            require(self._served("home-store") == "home@1.0.0", "home is not promoted")
            self._follow(url, "home@1.0.0", "lamp")
            after = self._answers(url)
            for habit in HABIT_SCENES:
                require(outliers(after[habit]) == [], f"{habit} is still an alarm")
            require(outliers(after["intruder"]) == ["toilet"], "the toilet is no alarm any more")
            record.step("Roll back to the default model")
            back = re.search(r"to roll back: (.+)", output)
            self._command(back[1] if back else "")
            require(self._served("home-store") == default, "the alias does not point back")
            self._follow(url, default, "lamp")
            require(self._answers(url) == before, "the answers are not those of the default")

    def _answers(self, url: str) -> dict[str, Any]:
        """Ask about a scene with each habit and one with an intruder."""
        scenes = HABIT_SCENES | {"intruder": INTRUDER}
        answers = {name: self._ask(url, "outliers", scene) for name, scene in scenes.items()}
        for answer in answers.values():
            del answer["request_id"]
        return answers

    def _confirm(self, url: str) -> None:
        """Confirm a scene of each habit on the page, and download the corrected file."""
        file, corrected = self._work / "scenes.home.jsonl", self._work / "corrected.jsonl"
        recorded = lines_of(file)
        require(len({labels(line) for line in recorded}) >= 20, "too few distinct scenes")
        require(len({line["group"] for line in recorded}) >= 5, "the scenes are of few hours")
        require(len(recorded) <= VISITS, "a visit was recorded twice")
        chosen = [
            (next(number for number, line in enumerate(recorded) if habit in labels(line)), habit)
            for habit in HABITS.values()
        ]
        with self._page(url) as page:
            for number, habit in chosen:
                page.get_by_role("button", name="Import, export").click()
                page.locator("#upload").set_input_files(file)
                page.locator("#which").fill(str(number + 1))
                page.get_by_role("button", name="Put on the board").click()
                page.get_by_role("tab", name="Wrong").click()
                if number == chosen[0][0]:
                    self._record.picture(page, "habit", "An alarm about a habit")
                page.get_by_role("button", name=f"Belongs here: {habit}").click()
                if page.locator("#confirm-scene").is_visible():  # another alarm is open
                    page.locator("#confirm-scene").click()
            page.get_by_text("Enough is confirmed").wait_for()
            self._record.picture(page, "confirmed", "A confirmed scene")
            page.get_by_role("button", name="Import, export").click()
            self._record.picture(page, "download", "The corrected file can be downloaded")
            with page.expect_download() as download:
                page.get_by_role("button", name=f"Download {file.name}").click()
            download.value.save_as(corrected)
        expected = [dict(line) for line in recorded]
        for number, _ in chosen:
            expected[number]["confirmed"] = True
        require(lines_of(corrected) == expected, "the corrected file has other differences")

    # --------------------------------------------------------------------------------- tools

    def _start_command(self) -> list[str]:
        if not self._install:
            return ["python", "-m", "app"]
        clone = self._work / "clone"
        self._command(f"git clone --quiet {shlex.quote(str(ROOT))} clone")
        return ["make", "--directory", str(clone), "run"]


def lines_of(file: Path) -> list[dict[str, Any]]:
    """Read a file of JSON lines."""
    return [json.loads(line) for line in file.read_text("utf-8").splitlines()]


def labels(line: dict[str, Any]) -> tuple[str, ...]:
    """Return the labels of a recorded scene."""
    return tuple(thing["label"] for thing in line["objects"])


def outliers(answer: dict[str, Any]) -> list[str]:
    """Return the objects with an alarm."""
    return [one["object"] for one in answer["outliers"] if one["is_outlier"]]


def shuffle_labels(source: Path, target: Path) -> None:
    """Write half of the scenes, with labels that are exchanged between all objects."""
    scenes = lines_of(source)[::2]
    every = [label for scene in scenes for label in labels(scene)]
    random.Random(0).shuffle(every)
    for scene in scenes:
        for thing in scene["objects"]:
            thing["label"] = every.pop()
    target.write_text("".join(json.dumps(scene) + "\n" for scene in scenes), "utf-8")


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
