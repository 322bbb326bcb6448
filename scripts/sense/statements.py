"""Ask a running service whether impossible statements are false, and sensible ones true.

    python -m scripts.sense.statements URL [--model NAME]

Each line of ``statements.jsonl`` is a small scene with one stated relation that is impossible or
sensible. Its lines alternate: the sensible line after an impossible one is its twin, with similar
words. The lines of the kind ``page`` are the examples of the design. `/outliers` answers for each
line, with ``unknown_labels`` ``nearest-or-ignore``. Counted are, of the lines of each sort:

- ``false``: `misplaced[].probability` of the stated relation is above 0.5.
- ``flagged``: `is_misplaced` of the stated relation is true.
- ``not judged``: `misplaced` has no entry for the stated relation. It counts as neither.
"""

from __future__ import annotations

import argparse
import json
from collections import Counter
from dataclasses import dataclass
from pathlib import Path

import httpx

STATEMENTS = Path(__file__).with_name("statements.jsonl")


@dataclass(frozen=True)
class Statement:
    """One line of the file: labels of a scene, and a triple (subject, relation, object)."""

    objects: list[str]
    relation: list[str]
    impossible: bool
    kind: str


@dataclass(frozen=True)
class Verdict:
    """Answer about one statement; the probability that it is false is None if not judged."""

    statement: Statement
    probability: float | None
    flagged: bool

    @property
    def false(self) -> bool:
        return self.probability is not None and self.probability > 0.5

    def __str__(self) -> str:
        p = "not judged" if self.probability is None else f"{self.probability:.2f}"
        flag = " flagged" if self.flagged else ""
        return f"{self.statement.kind:10} {' '.join(self.statement.relation):42} {p}{flag}"


def read_statements(path: Path = STATEMENTS) -> list[Statement]:
    return [Statement(**json.loads(line)) for line in path.read_text().splitlines()]


def judge(http: httpx.Client, statement: Statement, model: str) -> Verdict:
    """Ask `/outliers` about one statement.

    Raises:
        httpx.HTTPStatusError: the service refuses the scene.
    """
    body = {
        "objects": statement.objects,
        "relations": [statement.relation],
        "unknown_labels": "nearest-or-ignore",
        "model": model,
    }
    answer = http.post("/outliers", json=body).raise_for_status().json()
    for entry in answer["misplaced"]:
        if [entry.get(key) for key in ("subject", "relation", "object")] == statement.relation:
            return Verdict(statement, entry["probability"], entry["is_misplaced"])
    return Verdict(statement, None, False)


def _report(name: str, verdicts: list[Verdict]) -> None:
    """Print shares and failures of one sort of statements."""
    count = len(verdicts)
    false, flagged = sum(v.false for v in verdicts), sum(v.flagged for v in verdicts)
    missing = sum(v.probability is None for v in verdicts)
    print(
        f"{name:20} {count:3}: false {false} ({false / count:.1%}), "
        f"flagged {flagged} ({flagged / count:.1%}), not judged {missing}"
    )


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("url")
    parser.add_argument("--model", default="default")
    options = parser.parse_args()
    with httpx.Client(base_url=options.url, timeout=30) as http:
        verdicts = [judge(http, statement, options.model) for statement in read_statements()]
    for impossible, name in ((True, "impossible"), (False, "sensible")):
        group = [v for v in verdicts if v.statement.impossible == impossible]
        _report(f"{name}, page", [v for v in group if v.statement.kind == "page"])
        _report(f"{name}, further", [v for v in group if v.statement.kind != "page"])
    failures = [v for v in verdicts if v.false != v.statement.impossible]
    print("\nimpossible statements believed, by kind:")
    print(dict(Counter(v.statement.kind for v in failures if v.statement.impossible)))
    for verdict in failures:
        word = "believed" if verdict.statement.impossible else "wrong alarm"
        print(f"{word:11} {verdict}")


if __name__ == "__main__":
    main()
