"""results.json and results.md of a domain: its tables and what else was asked, from their folders.

<domain>/tables/          the main tables
<domain>/seed-protocol/   the seed paper's protocol
<domain>/shuffled/        the control
<domain>/results.*        all of these that are there

Each is written when it is done, whatever becomes of the next; a later run that does not ask for one
leaves it where it is.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from training.benchmark.measure import POOLED
from training.benchmark.summary import SEED_PRIMARY, Results
from training.evaluation.seed_protocol import PAPER

TABLES = "tables"
SEED_PROTOCOL = "seed-protocol"
SHUFFLED = "shuffled"

YARDSTICKS = {
    "T1a relations": ("relation popularity", "R-precision, distinct classes"),
    "T1 pairs": ("relation popularity", "accuracy"),
    "T2 missing": ("popularity", "MRR"),
    "T2 partial": ("popularity", "MRR, 50 %"),
    "T3 signature": ("popularity", "hit@1"),
}
"""What rows that learnt from shuffled scenes are asked: the row they must fall to, and in what."""

# Of a folder: the key in the domain's JSON.
_BESIDE = {SEED_PROTOCOL: "seed_protocol", SHUFFLED: "shuffled"}


def write_tables(folder: Path, results: Results, contents: Mapping[str, str]) -> None:
    """The main tables; the others likewise.

    Args:
        folder: of the section.
        contents: sha256 of what was read, by source.
    """
    _write(folder, results.to_dict(), results.markdown(), contents)


def write_protocol(folder: Path, results: Results, contents: Mapping[str, str]) -> None:
    """The seed paper's protocol, beside the paper's own figures."""
    _write(folder, results.to_dict() | {"paper": PAPER}, _protocol_text(results), contents)


def write_shuffled(
    folder: Path, results: Mapping[str, Results], contents: Mapping[str, str]
) -> None:
    """The control, by task."""
    values = {task: found.to_dict() for task, found in results.items()}
    _write(folder, values, shuffled_text(results), contents)


def assemble(folder: Path, name: str) -> str:
    """results.json and results.md of a domain, from the sections on disk; returns the latter.

    A section of other scenes than the tables is named and left out.
    """
    values: dict[str, Any] = {}
    parts = [f"# {name}\n"]
    if tables := _read(folder / TABLES):
        values = {"contents": tables[0]["contents"]} | tables[0]["results"]
        parts.append(tables[1])
    for place, key in _BESIDE.items():
        if not (found := _read(folder / place)):
            continue
        if tables and found[0]["contents"] != tables[0]["contents"]:
            parts.append(f"{place}/results.md is of other scenes than these tables: left out.\n")
            continue
        values[key] = found[0]["results"]
        parts.append(found[1])
    text = "\n".join(parts)
    _replace(folder / "results.json", json.dumps(values, indent=1))
    _replace(folder / "results.md", text)
    return text


def _write(
    folder: Path, results: Mapping[str, Any], text: str, contents: Mapping[str, str]
) -> None:
    folder.mkdir(parents=True, exist_ok=True)
    values = {"contents": dict(contents), "results": results}
    _replace(folder / "results.md", text)
    _replace(folder / "results.json", json.dumps(values, indent=1))


def _read(folder: Path) -> tuple[dict[str, Any], str] | None:
    path = folder / "results.json"
    if not path.exists():
        return None
    values: dict[str, Any] = json.loads(path.read_text(encoding="utf-8"))
    return values, (folder / "results.md").read_text(encoding="utf-8")


def _replace(path: Path, text: str) -> None:
    draft = path.with_name(path.name + ".part")
    draft.write_text(text, encoding="utf-8")
    draft.replace(path)


def _protocol_text(protocol: Results) -> str:
    names = list(dict.fromkeys(name for row in PAPER.values() for name in row))
    lines = [f"| | {' | '.join(names)} |", "|---" * (len(names) + 1) + "|"]
    for figure, values in PAPER.items():
        shown = [f"{values[name]:.4f}" if name in values else "" for name in names]
        lines.append(f"| {figure} | {' | '.join(shown)} |")
    paper = "\n".join(lines)
    return f"""## Seed protocol

One stochastic reconstruction answers, and scenes are split at random (60 / 30 / 10). These figures
are not comparable with the tables above, and they leak: near-duplicates of test scenes are in the
training part; relations that are left on hold or betray the removed object; switching on more
relations can only help T1, and returning a scene as it was given scores 1/V in T3.

{protocol.markdown(SEED_PRIMARY)}
The paper's own figures, on its own data:

{paper}
"""


def shuffled_text(shuffled: Mapping[str, Results]) -> str:
    """The section on the control, by task."""
    parts = [
        """## Shuffled labels

Rows trained on scenes whose objects were permuted between scenes: each scene has as many classes as
before and each class is in as many scenes, but what is there together is chance. Test scenes are
real. To be expected: MRR and hit@1 fall to those of popularity, R-precision over distinct classes
and the accuracy of pairs to those of relation popularity. A row that stays above was told something
that training scenes do not say. A star: the row in bold is better, with the whole interval.
"""
    ]
    for task, results in shuffled.items():
        _, metric = YARDSTICKS[task]
        above = [
            f"{d.row} by {-d.figure.value:.3f}"
            for d in results.differences
            if (d.source, d.metric) == (POOLED, metric) and d.figure.high < 0
        ]
        said = f"Above {results.ours} with the whole interval: {', '.join(above) or 'no row'}."
        parts.append(f"{results.markdown({task: (metric,)})}\n{said}\n")
    return "\n".join(parts)
