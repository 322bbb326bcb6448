"""The report of the command `init`: tables for people, and one JSON value for programs."""

from __future__ import annotations

from dataclasses import asdict
from typing import Any

from rich.console import Console
from rich.table import Table

from app.scene import label_key
from training.domain.proposal import Proposal

# Maximum number of rows of a printed table. The JSON report contains all rows.
ROWS = 12


def as_dict(proposal: Proposal) -> dict[str, Any]:
    """Return the analysis and the proposal as a JSON-serialisable dictionary."""
    coverage, dropped = ("classes", "share"), ("label", "mentions", "why")
    return {
        "name": proposal.name,
        "facts": asdict(proposal.facts),
        "labels": list(map(asdict, proposal.labels)),
        "lookalikes": list(map(asdict, proposal.lookalikes)),
        "minimum": proposal.minimum,
        "covered": {k: dict(zip(coverage, x, strict=True)) for k, x in proposal.covered.items()},
        "vocabulary": proposal.vocabulary.to_dict(),
        "dropped": [dict(zip(dropped, label, strict=True)) for label in proposal.dropped],
        "configuration": proposal.values,
        "reasons": proposal.reasons,
        "parts": proposal.parts,
        "test_groups": proposal.test_groups,
        "warning": proposal.warning,
    }


def show(proposal: Proposal, console: Console) -> None:
    """Print the report of a proposal as tables."""
    for part in (_facts, _labels, _lookalikes, _coverage, _findings, _choices):
        part(proposal, console)
    if proposal.warning:
        console.print(f"[yellow]warning:[/yellow] {proposal.warning}", soft_wrap=True)


def _facts(proposal: Proposal, console: Console) -> None:
    facts = proposal.facts
    least, mean, most = facts.objects_per_scene
    table = Table("item", "value", title=f"Scenes for {proposal.name}", title_justify="left")
    table.add_row("scenes", f"{facts.scenes} in {facts.groups} groups")
    table.add_row("objects", f"{facts.objects}: {least} to {most} a scene, {mean:.1f} on average")
    rooms = ", ".join(f"{room} {count}" for room, count in list(facts.rooms.items())[:ROWS])
    table.add_row("room types", rooms or "none")
    for name, share in facts.shares.items():
        table.add_row(f"with {name}", f"{share:.0%}")
    if facts.relations:
        triples = ", ".join(f"{name} {count}" for name, count in facts.relations.items())
        table.add_row("annotated relations", triples)
    console.print(table)


def _labels(proposal: Proposal, console: Console) -> None:
    labels = proposal.labels
    title = f"Labels: {len(labels)} in total; the most frequent ones:"
    table = Table("label", "mentions", "scenes", "spelt", title=title, title_justify="left")
    for label in labels[:ROWS]:
        spellings = ", ".join(label.spellings[:4])
        table.add_row(label.name, str(label.mentions), str(label.scenes), spellings)
    console.print(table)
    renamed = [label for label in labels if label_key(label.name) != label_key(label.spellings[0])]
    varied = [label for label in labels if len(label.spellings) > 1]
    if renamed:
        console.print("joined by built-in synonyms; vocabulary.json has the classes:")
    for label in renamed[:ROWS]:
        console.print(f"  {label.spellings[0]} = {label.name}", markup=False)
    if varied:
        console.print(f"labels with several spellings, each counted as one label: {len(varied)}")
    for label in varied[:ROWS]:
        console.print(f"  {' = '.join(label.spellings[:6])}", markup=False)


def _lookalikes(proposal: Proposal, console: Console) -> None:
    ordered = sorted(proposal.lookalikes, key=lambda pair: not pair.merged)
    table = Table("label", "like", "mentions", "proposal", "why", title_justify="left")
    table.title = "Similar labels"
    for pair in ordered[:ROWS]:
        a, b = pair.mentions
        action = "alias" if pair.merged else "two objects: check"
        table.add_row(pair.name, pair.like, f"{a}, {b}", action, pair.why)
    if ordered:
        console.print(table)
    if (more := len(ordered) - ROWS) > 0:
        console.print(f"and {more} more in the JSON report")


def _coverage(proposal: Proposal, console: Console) -> None:
    title = "Vocabulary: minimum mentions of a class, and the resulting coverage"
    table = Table("mentions", "classes", "covered", "", title=title, title_justify="left")
    for minimum, (classes, share) in proposal.covered.items():
        mark = "chosen" if minimum == proposal.minimum else ""
        table.add_row(str(minimum), str(classes), f"{share:.1%}", mark)
    console.print(table)
    if proposal.dropped:
        labels = ", ".join(f"{label} ({why})" for label, _, why in proposal.dropped[:ROWS])
        console.print(f"labels without a class, {len(proposal.dropped)}: {labels}", markup=False)


def _findings(proposal: Proposal, console: Console) -> None:
    findings = proposal.facts.findings
    console.print("Please check:" if findings else "no contradictions found")
    for finding in findings:
        console.print(f"  [yellow]{finding.count}[/yellow] × {finding.what}")
        console.print(f"    {finding.advice}")
        for example in finding.examples:
            console.print(f"    - {example}", markup=False)


def _choices(proposal: Proposal, console: Console) -> None:
    table = Table("entry", "value", "why", title="Configuration", title_justify="left")
    for name, reason in proposal.reasons.items():
        section, _, entry = name.partition(".")
        if entry in proposal.values[section]:
            table.add_row(name, str(proposal.values[section][entry]), reason)
    console.print(table)
