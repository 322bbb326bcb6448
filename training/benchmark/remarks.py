"""What honesty asks beside the figures: how many scenes were skipped, and a task's notes."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass


@dataclass(frozen=True)
class Asked:
    """What has to be said beside the figures of one task.

    Attributes:
        row, seed, task, source: where it stands.
        scenes, skipped: how many were asked about, and how many of them could not be scored.
        notes: such as a bandwidth, or log Z with its standard errors.
    """

    row: str
    seed: int
    task: str
    source: str
    scenes: int
    skipped: int
    notes: Mapping[str, float]


def remarks(asked: Sequence[Asked]) -> list[str]:
    """Paragraphs and tables for below the figures of one task."""
    parts = [text for text in (_skipped(asked),) if text]
    noted = [one for one in asked if one.notes]
    return [*parts, _notes(noted)] if noted else parts


def _skipped(asked: Sequence[Asked]) -> str:
    shown = []
    for source in dict.fromkeys(one.source for one in asked):
        here = [one for one in asked if one.source == source]
        skipped, scenes = _range(one.skipped for one in here), _range(one.scenes for one in here)
        if skipped != "0":
            shown.append(f"{source} {skipped} of {scenes}")
    return f"Scenes that could not be scored: {', '.join(shown)}." if shown else ""


def _range(counts: Iterable[int]) -> str:
    """Of all rows; rows that answer about other scenes show as two numbers."""
    low, *others = sorted(set(counts))
    return f"{low:,}–{others[-1]:,}" if others else f"{low:,}"


def _notes(asked: Sequence[Asked]) -> str:
    """By source where the rows agree, by row where the sources agree, else by both."""
    for key in (_of_source, _of_row):
        found: dict[str, set[tuple[tuple[str, float], ...]]] = {}
        for one in asked:
            found.setdefault(key(one), set()).add(tuple(one.notes.items()))
        if all(len(notes) == 1 for notes in found.values()):
            return _table({name: dict(*notes) for name, notes in found.items()})
    return _table({f"{_of_row(one)}, {_of_source(one)}": one.notes for one in asked})


def _of_source(one: Asked) -> str:
    return one.source


def _of_row(one: Asked) -> str:
    return f"{one.row}, seed {one.seed}"


def _table(notes: Mapping[str, Mapping[str, float]]) -> str:
    names = list(dict.fromkeys(name for values in notes.values() for name in values))
    lines = [f"| | {' | '.join(names)} |", "|---" * (len(names) + 1) + "|"]
    for key, values in notes.items():
        shown = [_number(values[name]) if name in values else "" for name in names]
        lines.append(f"| {key} | {' | '.join(shown)} |")
    return "\n".join(lines)


def _number(value: float) -> str:
    return f"{value:,.0f}" if float(value).is_integer() else f"{value:,.3f}"
