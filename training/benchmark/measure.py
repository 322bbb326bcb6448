"""The loop over rows and sources; whatever a file holds already is not computed again.

<folder>/<row>/seed-<n>/entry.json        its identity, what it learnt from, how many weights
                        trials.jsonl      every trial of its tuning
                        run/              the training run of a machine, and its calibration
                        <source>.json     its report on a source
                        pooled.json       what does not follow from these: see `WHOLE_SET`
"""

from __future__ import annotations

import json
import re
import shutil
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

from training.benchmark.entries import Entry, Material, Rival
from training.evaluation.report import SourceReport, digest, measure, pooled
from training.evaluation.tasks import ONCE, WHOLE_SET, Setting

# Called with (row, source, what is being done).
Progress = Callable[[str, str, str], None]
# The last word on a row and a source: measured now, or known from a file.
DONE, KNOWN = "done", "known"

POOLED = "pooled"
"""All sources together."""


class BenchmarkError(RuntimeError):
    """Files in the folder that are of another benchmark; says which."""


@dataclass(frozen=True, eq=False)
class Plan:
    """What every row is asked.

    Attributes:
        folder: of the reports.
        material: what rows learn from.
        settings: by source, and `POOLED` for all of them.
        tasks: names in `TASKS` or `SEED_TASKS`.
    """

    folder: Path
    material: Material
    settings: Mapping[str, Setting]
    tasks: Sequence[str]

    def place(self, entry: Entry) -> Path:
        """The folder of one row and seed."""
        return place_of(self.folder, entry.name, entry.seed)

    def asked(self, source: str) -> list[str]:
        """The tasks that are measured on a source."""
        if source == POOLED:
            return [task for task in self.tasks if task in WHOLE_SET]
        return [task for task in self.tasks if task not in ONCE]

    def known(self, entry: Entry) -> dict[str, SourceReport]:
        """The finished reports of a row, by source.

        Raises:
            BenchmarkError: the folder holds reports of other scenes, or of a row that was
                configured otherwise or learnt from other scenes.
        """
        claim(self.place(entry), entry, self.material.digest)
        found = {}
        for source, setting in self.settings.items():
            path = self.place(entry) / f"{source}.json"
            if not self.asked(source):
                found[source] = SourceReport(source, digest(setting))
            elif path.exists():
                report = read_report(path, setting)
                if set(self.asked(source)) <= set(report.outcomes):
                    found[source] = report
        return found

    def measure(self, entry: Entry, progress: Progress) -> None:
        """Fill in a row's report on every source, training it only where one lacks a task.

        KeyboardInterrupt passes through; finished tasks are on disk by then.

        Raises:
            BenchmarkError: see `known`.
        """
        known = self.known(entry)
        rival: Rival | None = None
        for source, setting in self.settings.items():
            if source in known:
                progress(entry.name, source, KNOWN)
                continue
            say = partial(progress, entry.name, source)
            place = self.place(entry)
            if rival is None:
                say("training")
                rival = entry.make(self.material, place, say)
            contender = rival(setting)
            _note_parameters(place, contender.parameters)
            path = place / f"{source}.json"
            measure(path, contender, setting, source, tasks=self.asked(source), progress=say)
            say(DONE)

    def report(self, entry: Entry) -> dict[str, SourceReport]:
        """A measured row's reports as its files have them, that of the pool with all tasks."""
        found = self.known(entry)
        sources = [found[source] for source in self.settings if source != POOLED]
        if POOLED in self.settings:
            whole = found[POOLED]
            every = pooled(sources, POOLED)
            every.outcomes |= whole.outcomes
            found[POOLED] = every
        return {source: found[source] for source in self.settings}


def measure_entries(
    plan: Plan, entries: Sequence[Entry], progress: Progress
) -> dict[tuple[str, int], dict[str, SourceReport]]:
    """Every row's report on every source, by (name, seed), one row after the other."""
    for entry in entries:
        plan.measure(entry, progress)
    return {(entry.name, entry.seed): plan.report(entry) for entry in entries}


def place_of(folder: Path, name: str, seed: int) -> Path:
    """Where a row of one seed lies."""
    return folder / slug(name) / f"seed-{seed}"


def slug(name: str) -> str:
    """A folder's name: lower case, words joined by hyphens."""
    return re.sub(r"[^a-z0-9]+", "-", name.lower()).strip("-")


def forget(folder: Path, entries: Sequence[Entry]) -> None:
    """Remove what the folder knows of these rows."""
    for entry in entries:
        shutil.rmtree(place_of(folder, entry.name, entry.seed), ignore_errors=True)


def parameters(folder: Path, entries: Sequence[Entry]) -> dict[str, int]:
    """Trained weights of the rows of which a number says something, by name."""
    found = {}
    for entry in entries:
        path = place_of(folder, entry.name, entry.seed) / "entry.json"
        count = json.loads(path.read_text(encoding="utf-8")).get("parameters")
        if count is not None:
            found[entry.name] = int(count)
    return found


def claim(place: Path, entry: Entry, material: str) -> None:
    """Write down whose folder this is.

    Args:
        material: digest of what the row learns from.

    Raises:
        BenchmarkError: it is another one's.
    """
    path = place / "entry.json"
    if path.exists():
        known = json.loads(path.read_text(encoding="utf-8"))
        if known["identity"] != entry.identity:
            raise BenchmarkError(
                f"{place} holds another configuration of {entry.name}; give --fresh or another "
                "folder"
            )
        if known.get("material") != material:
            raise BenchmarkError(
                f"{place} learnt from other scenes than these, or does not say from which: another "
                "file, source, limit, split or vocabulary; give --fresh or another folder"
            )
        return
    place.mkdir(parents=True, exist_ok=True)
    values = {"name": entry.name, "seed": entry.seed, "identity": entry.identity}
    _write(path, values | {"material": material})


def read_report(path: Path, setting: Setting) -> SourceReport:
    """The report in a file.

    Raises:
        BenchmarkError: it is of other scenes or questions.
    """
    report = SourceReport.from_dict(json.loads(path.read_text(encoding="utf-8")))
    if report.scenes != digest(setting):
        raise BenchmarkError(
            f"{path} is of other scenes or questions; give --fresh or another folder"
        )
    return report


def _note_parameters(place: Path, count: int | None) -> None:
    path = place / "entry.json"
    values = json.loads(path.read_text(encoding="utf-8"))
    if values.get("parameters") != count:
        _write(path, values | {"parameters": count})


def _write(path: Path, values: Mapping[str, object]) -> None:
    draft = path.with_name(path.name + ".part")
    draft.write_text(json.dumps(values), encoding="utf-8")
    draft.replace(path)
