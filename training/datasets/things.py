"""Written facts about things in `things.csv`: sizes, where they stand, broader and other names."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from app.scene import label_key
from training.datasets.tables import Errors, Row, read_table

COLUMNS: Final = (
    *("label", "long", "wide", "high", "large", "stands", "surface", "container", "carried"),
    *("parent", "other_names"),
)
_PLACES: Final = ("floor", "wall", "ceiling", "surface", "inside")
_SOMETIMES: Final = ("no", "sometimes", "yes")
_CARRIERS: Final = ("hand", "hands", "people", "no")


@dataclass(frozen=True, slots=True)
class Thing:
    """A kind of thing."""

    label: str
    size: tuple[float, float, float]  # extents of a typical one in metres: long, wide and high
    large: float  # length of a large one, divided by the typical length
    stands: Mapping[str, float]  # share of each of `_PLACES` where it stands
    surface: str  # whether things are commonly put on it: no, sometimes or yes
    container: str  # whether things are commonly put into it: no, sometimes or yes
    carried: str  # by one hand, two hands, two people, or nobody ("no")
    parent: str  # label of the broader thing, or ""
    other_names: tuple[str, ...]  # names that detectors use for it


def read_things(path: Path) -> dict[str, Thing]:
    """Read the things by label, in the order of the file.

    Raises:
        DatasetError: the file or a value is invalid, a label occurs twice, a parent has no row, or
            parents form a loop. It names line and column; InvalidLinesError: several errors.
    """
    things: dict[str, Thing] = {}
    rows: dict[str, Row] = {}
    keys: set[str] = set()
    errors = Errors(path)
    for row in read_table(path, COLUMNS, errors):
        with errors:
            thing = _thing(row)
            if (key := label_key(thing.label)) in keys:
                raise row.error("label", f"{thing.label!r} has two rows")
            keys.add(key)
            things[thing.label], rows[thing.label] = thing, row
    errors.check()
    for label, row in rows.items():
        with errors:
            _check_parents(label, things, row)
    errors.check()
    return things


def _check_parents(label: str, things: Mapping[str, Thing], row: Row) -> None:
    """Raise DatasetError if a parent has no row, or if the parents form a loop."""
    seen, at = {label}, things[label].parent
    while at:
        if at not in things:
            raise row.error("parent", f"{at!r} has no row")
        if at in seen:
            raise row.error("parent", f"the parents of {label!r} lead back to {at!r}")
        seen.add(at)
        at = things[at].parent


def _thing(row: Row) -> Thing:
    return Thing(
        label=row.text("label"),
        size=(row.number("long", 1000), row.number("wide", 1000), row.number("high", 1000)),
        large=row.number("large", 100),
        stands=_stands(row),
        surface=row.one_of("surface", _SOMETIMES),
        container=row.one_of("container", _SOMETIMES),
        carried=row.one_of("carried", _CARRIERS),
        parent=row.optional("parent"),
        other_names=tuple(filter(None, map(str.strip, row.optional("other_names").split(",")))),
    )


def _stands(row: Row) -> dict[str, float]:
    """Return the share of each place where a thing stands. The shares add up to 1."""
    words = row.text("stands").split()
    try:
        shares = {place: float(share) for place, share in zip(words[::2], words[1::2], strict=True)}
    except ValueError:
        shares = {}
    is_valid = set(shares) <= set(_PLACES) and len(words) == 2 * len(shares)
    is_valid = is_valid and all(0 < share <= 1 for share in shares.values())
    if not is_valid or abs(sum(shares.values()) - 1) > 0.011:
        places = ", ".join(_PLACES)
        problem = f"must list shares that add up to 1, such as `floor .9 inside .1`; of {places}"
        raise row.error("stands", problem)
    return shares
