"""The loop over rows and sources; whatever a file holds already is not computed again.

<folder>/<row>/seed-<n>/entry.json        the row's identity
                        trials.jsonl      every trial of its tuning
                        run/              the training run of a machine
                        <source>.json     its report on a source
"""

from __future__ import annotations

import json
import re
import shutil
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path

from training.benchmark.entries import Entry
from training.evaluation.contenders import Contender
from training.evaluation.report import SourceReport, digest, measure
from training.evaluation.tasks import Setting

# Called with (row, source, what is being done).
Progress = Callable[[str, str, str], None]


class BenchmarkError(RuntimeError):
    """Files in the folder that are of another benchmark; says which."""


def measure_entries(
    folder: Path,
    entries: Sequence[Entry],
    settings: Mapping[str, Setting],
    tasks: Sequence[str],
    progress: Progress,
) -> dict[tuple[str, int], dict[str, SourceReport]]:
    """Every row's report on every source, by (name, seed).

    A row is trained only where one of its reports lacks a task. KeyboardInterrupt passes through;
    finished tasks are on disk by then.

    Args:
        settings: by source; "pooled" may be one of them.

    Raises:
        BenchmarkError: the folder holds reports of other scenes, or of a row that was configured
            otherwise.
    """
    found: dict[tuple[str, int], dict[str, SourceReport]] = {}
    for entry in entries:
        place = folder / slug(entry.name) / f"seed-{entry.seed}"
        _claim(place, entry)
        made: Contender | None = None
        reports: dict[str, SourceReport] = {}
        for source, setting in settings.items():
            path = place / f"{source}.json"
            known = _report(path, setting) if path.exists() else None
            if known is not None and set(tasks) <= set(known.outcomes):
                reports[source] = known
                progress(entry.name, source, "known")
                continue
            if made is None:
                progress(entry.name, source, "training")
                made = entry.make(place, partial(progress, entry.name, source))
            measure(
                path,
                made,
                setting,
                source,
                tasks=tasks,
                progress=partial(progress, entry.name, source),
            )
            # As the file has it, whose numbers are rounded: a resumed benchmark finds the same.
            reports[source] = _report(path, setting)
            progress(entry.name, source, "done")
        found[entry.name, entry.seed] = reports
    return found


def slug(name: str) -> str:
    """A folder's name: lower case, words joined by hyphens."""
    return re.sub(r"[^a-z0-9]+", "-", name.lower()).strip("-")


def forget(folder: Path, entries: Sequence[Entry]) -> None:
    """Remove what the folder knows of these rows."""
    for entry in entries:
        shutil.rmtree(folder / slug(entry.name) / f"seed-{entry.seed}", ignore_errors=True)


def _claim(place: Path, entry: Entry) -> None:
    path = place / "entry.json"
    if path.exists():
        identity = json.loads(path.read_text(encoding="utf-8"))["identity"]
        if identity != entry.identity:
            raise BenchmarkError(
                f"{place} holds another configuration of {entry.name}; give --fresh or another "
                "folder"
            )
        return
    place.mkdir(parents=True, exist_ok=True)
    values = {"name": entry.name, "seed": entry.seed, "identity": entry.identity}
    path.write_text(json.dumps(values), encoding="utf-8")


def _report(path: Path, setting: Setting) -> SourceReport:
    report = SourceReport.from_dict(json.loads(path.read_text(encoding="utf-8")))
    if report.scenes != digest(setting):
        raise BenchmarkError(
            f"{path} is of other scenes or questions; give --fresh or another folder"
        )
    return report
