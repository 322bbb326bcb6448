"""Tables of answers for terminals. Programs should use the JSON output."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Final, Literal

from pydantic import BaseModel
from rich import box
from rich.console import Group, RenderableType
from rich.table import Table

from scene_client import phrases, schemas

MOST_MISPLACED: Final = 10
"""Maximum number of table rows with probably false relations.

A scene of twelve objects with positions can have a hundred relations.
"""

MOST_RELATIONS: Final = 12
"""Maximum number of relations of a sampled scene in a table. Vertical relations come first."""

LIKELY_PLACE: Final = 0.25
"""Minimum probability of a place in a table of missing objects.

A table of answers about one place contains all places.
"""

POSSIBLE_PLACE: Final = 0.01
"""Minimum probability of a place in a table of the places of one thing."""


def relations(answer: schemas.RelationsAnswer) -> RenderableType:
    """Return a table of relations, most probable first, and a table of disagreements."""
    rows = [
        (
            *_relation(entry),
            "observed" if entry.observed else "",
            "" if entry.expected is None else f"{entry.expected:.3f}",
        )
        for entry in answer.relations
    ]
    disagreements = [
        (
            *(entry.subject, ", ".join(entry.observed), entry.object),
            f"{entry.observed_probability:.3f}",
            f"{entry.expected} {entry.probability:.3f}",
        )
        for entry in answer.disagreements
    ]
    return _tables(
        _table("subject", "relation", "object", "probability", "", "if not observed", rows=rows),
        _table(
            *("subject", "observed", "object", "probability", "expected"),
            rows=disagreements,
            title="disagreements",
        ),
    )


def missing(answer: schemas.MissingAnswer, *, is_at_place: bool = False) -> RenderableType:
    """Return a table of missing objects with places and reasons, and a table of counts.

    Args:
        is_at_place: True if the request names a place.
    """
    least = 0.0 if is_at_place else LIKELY_PLACE
    rows = [
        (
            *(_class(entry), f"{entry.probability:.3f}", f"{entry.log_odds:+.2f}"),
            "\n".join(_placement(p) for p in entry.placements if p.probability >= least),
            _reasons(entry.because),
        )
        for entry in answer.missing
    ]
    counts = [
        (
            *(_class(entry), str(entry.listed_count)),
            f"{entry.expected_count:.1f} ({entry.low} to {entry.high})",
            f"{entry.probability:.3f}",
        )
        for entry in answer.more
    ]
    table = _table("missing", "probability", "log-odds", "where", "because", rows=rows)
    more = _table("more of", "listed", "expected", "probability", rows=counts)
    if not rows:
        return more if counts else "No object is missing."
    return _tables(table, more)


def outliers(answer: schemas.OutliersAnswer) -> RenderableType:
    """Return a table of objects, most probable outlier first, and a table of false relations."""
    rows = [
        (
            *(entry.object, _class(entry), f"{entry.probability:.3f}"),
            "" if entry.log_odds is None else f"{entry.log_odds:+.2f}",
            "" if entry.real is None else f"{entry.real:.3f}",
            "outlier" if entry.is_outlier else entry.reason or "",
            _reasons(entry.because),
            ", ".join(entry.usually_with),
        )
        for entry in answer.outliers
    ]
    heads = ("object", "label", "probability", "log-odds", "real", "", "because", "usually with")
    misplaced = [
        (*_relation(entry), *(("misplaced", entry.moved or "") if entry.is_misplaced else ("", "")))
        for entry in answer.misplaced[:MOST_MISPLACED]
    ]
    columns = ("subject", "relation", "object", "probability of being wrong", "", "moved")
    title = "relations as given"
    if len(misplaced) < len(answer.misplaced):
        title += f": the {len(misplaced)} likeliest to be wrong of {len(answer.misplaced)}"
    return _tables(_table(*heads, rows=rows), _table(*columns, rows=misplaced, title=title))


def rooms(answer: schemas.RoomsAnswer) -> RenderableType:
    """Return a table of room types, most probable first."""
    rows = [
        (
            *(entry.room_type, ", ".join(entry.listed_as or ()), f"{entry.probability:.3f}"),
            _reasons(entry.because),
        )
        for entry in answer.room_types
    ]
    return _table("room type", "listed as", "probability", "because", rows=rows)


def where(answer: schemas.WhereAnswer, *, rooms: Iterable[object] = ()) -> RenderableType:
    """Return a table of the places of one thing, most probable first, and of its absence.

    Args:
        answer: the answer.
        rooms: rooms of the request, whose objects have labels.
    """
    labels = phrases.labels_in(rooms)
    likely = [entry for entry in answer.places if entry.probability >= POSSIBLE_PLACE]
    others = 1.0 - answer.not_here - sum(entry.probability for entry in likely)
    rows = [(_place(entry, labels), f"{entry.probability:.3f}") for entry in likely]
    if others >= POSSIBLE_PLACE:
        rows.append(("at another place", f"{others:.3f}"))
    rows.append(("not here", f"{answer.not_here:.3f}"))
    title = _named(answer.label, answer.listed_as)
    return _table("place", "probability", rows=rows, title=title)


def generate(answer: schemas.GenerateAnswer) -> RenderableType:
    """Return a table of the sampled scenes."""
    words = answer.listed_as or {}
    rows = [
        (
            *(str(n), ", ".join(_named(label, words.get(label)) for label in scene.objects)),
            *(_relations(scene.relations, words), f"{scene.log_score:.1f}"),
        )
        for n, scene in enumerate(answer.scenes, 1)
    ]
    title = f"seed {answer.seed}"
    return _table("scene", "objects", "relations", "log score", rows=rows, title=title)


def models(answer: schemas.ModelList) -> RenderableType:
    """Return a table of versions with their aliases, and the unusable entries of the store."""
    rows = [
        (
            *(f"{model.name}@{version.version}", version.variant or "", ", ".join(version.aliases)),
            ": ".join(filter(None, (version.status, version.reason))),
        )
        for model in answer.models
        for version in model.versions
    ]
    failures = [(failure.subject, failure.reason, failure.detail) for failure in answer.failures]
    return _tables(
        _table("model", "variant", "aliases", "status", rows=rows),
        _table("failed", "reason", "detail", rows=failures),
    )


def vocabulary(answer: schemas.VocabularyAnswer) -> RenderableType:
    """Return a table of object classes with their aliases."""
    rows = [
        (entry.label, ", ".join(entry.aliases), "structure" if entry.structure else "")
        for entry in answer.objects
    ]
    title = f"room types: {', '.join(answer.room_types) or 'none'}"
    if answer.profiles:
        title += f"\nprofiles: {', '.join(answer.profiles)}"
    return _table("object", "also", "", rows=rows, title=title)


def notes(answer: BaseModel) -> list[str]:
    """Return one line for each mapped or resolved label, and for each warning of the answer.

    The warning `several-rooms` also has one line for each room.
    """
    if not isinstance(answer, schemas.Answer):
        return []
    mapped = [
        f"{entry.label}: read as {entry.class_} "
        f"(rule {entry.rule}, similarity {entry.similarity:.2f})"
        for entry in answer.mapped
    ]
    resolved = [
        f"{entry.object}: {', '.join(f'{one.label} {one.probability:.2f}' for one in entry.labels)}"
        " (as the other objects decide)"
        for entry in answer.resolved or ()
    ]
    warnings = [
        line
        for entry in answer.warnings
        for line in (
            ": ".join(filter(None, (entry.code, ", ".join(entry.objects), entry.message))),
            *(f"  {room.room_type}: {', '.join(room.objects)}" for room in entry.rooms or ()),
        )
    ]
    return mapped + resolved + warnings


def _table(*columns: str, rows: Sequence[Sequence[str]], title: str | None = None) -> Table:
    table = Table(box=box.SIMPLE_HEAD, title=title, title_justify="left")
    # Answers with `detail: scores` have no places and no reasons.
    shown = [n for n in range(len(columns)) if not rows or any(row[n] for row in rows)]
    for column in [columns[n] for n in shown]:
        has_numbers = column.startswith("probability") or column in {"log-odds", "log score"}
        # Only cells with the objects of a scene can be long. Other cells have short lines.
        width = 60 if column == "objects" else None
        side: Literal["left", "right"] = "right" if has_numbers else "left"
        # A narrow terminal wraps an id, because two shortened ids may look the same.
        table.add_column(column, justify=side, max_width=width, overflow="fold")
    for row in rows:
        table.add_row(*[row[n] for n in shown])
    return table


def _tables(first: Table, second: Table) -> RenderableType:
    return Group(first, second) if second.row_count else first


def _relation(entry: schemas.ScoredRelation) -> tuple[str, str, str, str]:
    return entry.subject, entry.relation, entry.object, f"{entry.probability:.3f}"


def _class(entry: schemas.MissingObject | schemas.MoreInstances | schemas.Outlier) -> str:
    return _named(entry.label, entry.listed_as)


def _named(label: str, word: str | None) -> str:
    """Return the word of the request, with its class in parentheses if this has another name."""
    return label if word is None else f"{word} ({label})"


def _relations(relations: Sequence[schemas.Relation], words: Mapping[str, str]) -> str:
    ranked = sorted(relations, key=lambda entry: entry.relation in {"left", "front"})
    lines = [
        f"{words.get(r.subject, r.subject)} {r.relation} {words.get(r.object, r.object)}"
        for r in ranked[:MOST_RELATIONS]
    ]
    if len(ranked) > MOST_RELATIONS:
        lines.append(f"… and {len(ranked) - MOST_RELATIONS} more")
    return "\n".join(lines)


def _place(spot: schemas.Spot, labels: phrases.Labels) -> str:
    """Return a place in words, such as "bathroom: on top of sink_1"."""
    if spot.is_listed:
        return f"{spot.room}: seen there ({spot.object})"
    return f"{spot.room}: {phrases.spot(spot, labels) if spot.object else 'elsewhere'}"


def _placement(placement: schemas.Placement) -> str:
    text = f"{placement.relation} {placement.object} {placement.probability:.3f}"
    # A model has no offsets if its training scenes have no positions.
    offset = placement.offset
    if offset is None:
        return text
    axes = (f"{n} {getattr(offset.mean, n):+.2f}±{getattr(offset.std, n):.2f}" for n in "xyz")
    return f"{text} ({', '.join(axes)} m)"


def _reasons(because: Iterable[schemas.Because]) -> str:
    return "\n".join(f"{reason.object} {reason.log_odds_change:+.2f}" for reason in because)
