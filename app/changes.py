"""What changed between two answers, and answers from what changed: one the inverse of the other.

Answers are lists of entries by name, as JSON has them. Within a list no two entries have the same
texts, by which they are told apart.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from app.messages import ListChanges

Entry = dict[str, Any]
Lists = Mapping[str, Sequence[Entry]]
_Key = tuple[str, ...]


def difference(before: Lists, after: Lists) -> tuple[dict[str, ListChanges], list[str]]:
    """The lists that changed or came, by name, and the names of those that went."""
    changes = {
        name: _between(before.get(name, ()), entries)
        for name, entries in after.items()
        if name not in before or before[name] != entries
    }
    return changes, [name for name in before if name not in after]


def applied(
    before: Lists, changes: Mapping[str, ListChanges], dropped: Sequence[str]
) -> dict[str, list[Entry]]:
    """The lists after the changes.

    Raises:
        KeyError, IndexError: these are no changes of these lists.
    """
    after = {name: list(entries) for name, entries in before.items() if name not in dropped}
    for name, change in changes.items():
        after[name] = _changed(after.get(name, ()), change)
    return after


def _key(entry: Mapping[str, Any]) -> _Key:
    """The texts of an entry; in one list they all have the same names, in the same order."""
    return tuple([value for value in entry.values() if type(value) is str])


def _texts(entry: Mapping[str, Any]) -> dict[str, str]:
    return {name: value for name, value in entry.items() if type(value) is str}


def _between(before: Sequence[Entry], after: Sequence[Entry]) -> ListChanges:
    old = {_key(entry): entry for entry in before}
    new = {_key(entry): entry for entry in after}
    kept = [key for key in old if key in new]
    came = [key for key in new if key not in old]
    place = {key: k for k, key in enumerate([*kept, *came])}
    order = [place[key] for key in new]
    return ListChanges(
        gone=[_texts(entry) for key, entry in old.items() if key not in new] or None,
        changed=[new[key] for key in kept if new[key] != old[key]] or None,
        appeared=[new[key] for key in came] or None,
        order=None if order == list(range(len(order))) else order,
    )


def _changed(before: Sequence[Entry], change: ListChanges) -> list[Entry]:
    entries = {_key(entry): entry for entry in before}
    for texts in change.gone or ():
        del entries[_key(texts)]
    for entry in change.changed or ():
        # An entry that is not there would be put at the end, and the order would hide it.
        if _key(entry) not in entries:
            raise KeyError(_key(entry))
        entries[_key(entry)] = entry
    for entry in change.appeared or ():
        entries[_key(entry)] = entry
    found = list(entries.values())
    return found if change.order is None else [found[place] for place in change.order]
