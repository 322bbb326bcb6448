"""Changes applied to what was before give what is now, whatever both are."""

from __future__ import annotations

import json
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from app.changes import applied, difference
from app.messages import ListChanges

NAMES = st.sampled_from(["missing", "outliers", "relations"])
ENTRIES = st.lists(
    st.fixed_dictionaries(
        {
            "object": st.sampled_from("abcdef"),
            "label": st.sampled_from(["bed", "lamp"]),
            "probability": st.floats(0, 1),
            "is_outlier": st.booleans(),
            "because": st.lists(st.fixed_dictionaries({"object": st.sampled_from("ab")})),
        }
    ),
    max_size=8,
    unique_by=lambda entry: (entry["object"], entry["label"]),
)
LISTS = st.dictionaries(NAMES, ENTRIES)


def over_the_wire(changes: dict[str, ListChanges]) -> dict[str, ListChanges]:
    texts = {name: change.model_dump_json(exclude_none=True) for name, change in changes.items()}
    return {name: ListChanges.model_validate_json(text) for name, text in texts.items()}


@given(LISTS, LISTS)
def test_changes_lead_from_any_lists_to_any_others(
    before: dict[str, Any], after: dict[str, Any]
) -> None:
    kept = json.dumps(before)
    changes, dropped = difference(before, after)
    assert applied(before, over_the_wire(changes), dropped) == after
    assert json.dumps(before) == kept


@given(LISTS)
def test_nothing_changed_is_nothing_said(lists: dict[str, Any]) -> None:
    assert difference(lists, lists) == ({}, [])


def test_only_what_changed_is_said() -> None:
    entries: list[dict[str, Any]] = [
        {"object": name, "label": "lamp", "probability": 0.1 * k} for k, name in enumerate("abcd")
    ]
    moved = [entries[2], entries[0] | {"probability": 0.9}, entries[3]]
    (change,) = difference({"outliers": entries}, {"outliers": moved})[0].values()
    assert change.gone == [{"object": "b", "label": "lamp"}]
    assert change.changed == [{"object": "a", "label": "lamp", "probability": 0.9}]
    assert change.appeared is None
    # Of a, c, d as they are left.
    assert change.order == [1, 0, 2]


def test_changes_of_other_lists_are_noticed() -> None:
    change = ListChanges(changed=[{"label": "bed", "probability": 0.5}])
    with pytest.raises(KeyError):
        applied({}, {"missing": change}, [])
    with pytest.raises(KeyError):
        applied({}, {"missing": ListChanges(gone=[{"label": "bed"}])}, [])
