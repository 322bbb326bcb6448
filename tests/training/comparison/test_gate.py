from __future__ import annotations

from dataclasses import replace
from functools import partial
from pathlib import Path
from types import SimpleNamespace

import pytest

from app.registry import Store
from tests.http.stores import corrupt, make_store
from training.comparison import gate
from training.comparison.compare import Comparison, unmeasured
from training.comparison.differences import RELATIONAL, Difference
from training.comparison.gate import WorseError, seat
from training.comparison.sides import Side
from training.evaluation.intervals import Figure


def comparison(*rows: tuple[str, bool, float, float]) -> Comparison:
    """Of rows (metric, primary, low, high)."""
    differences = tuple(
        Difference("T2 missing", name, primary, 0.5, 0.5, Figure((low + high) / 2, low, high, 9))
        for name, primary, low, high in rows
    )
    return Comparison("new", "old", 40, 20, True, (), differences, ())


@pytest.mark.parametrize(
    ("primary", "low", "high", "margin", "worse"),
    [
        (True, -0.20, -0.03, 0.02, True),
        (True, -0.20, -0.03, 0.05, False),  # borne
        (True, -0.20, 0.01, 0.02, False),  # may be chance
        (True, -0.20, -0.01, 0.02, False),  # worse for sure, beyond the margin not for sure
        (False, -0.20, -0.10, 0.02, False),  # not what the task is judged by
        (True, -0.20, -0.01, 0.0, True),
    ],
)
def test_worse_is_what_lies_beyond_the_margin_entirely(primary, low, high, margin, worse) -> None:
    found = comparison(("MRR", primary, low, high), ("top-1", True, 0.1, 0.2))
    assert [row.metric for row in found.worse_by(margin)] == (["MRR"] if worse else [])


def test_a_refusal_names_every_metric_that_is_worse() -> None:
    found = comparison(("MRR", True, -0.3, -0.2), ("hit@1", True, -0.3, -0.1), ("AP", True, 0, 1))
    text = str(WorseError(found, 0.02))
    assert "MRR (-0.250" in text
    assert "hit@1" in text
    assert "AP" not in text
    assert found.to_dict()["differences"][0]["verdict"] == "worse"
    assert replace(found, differences=()).worse_by(0) == []


@pytest.mark.parametrize(
    ("measured", "task", "expected"),
    [
        (("T2 missing", "T3b placement", "T1a relations"), "T2 missing", 2),
        (("T2 missing", "T1a relations"), "T1a relations", 0),  # some scenes tell of relations
        (("T2 missing",), "T2 missing", 0),  # nor does what is served know of any
    ],
)
def test_what_was_measured_at_relations_gives_way_to_nothing_that_was_not(
    measured, task, expected, monkeypatch
) -> None:
    manifest = SimpleNamespace(metrics=[SimpleNamespace(task=name) for name in measured])
    holder = Side("old", None, {}, SimpleNamespace(manifest=manifest))  # type: ignore[arg-type]
    row = Difference(task, "MRR", True, 0.5, 0.5, Figure(0, -0.1, 0.1, 9))
    names = unmeasured([row], holder)
    assert len(names) == expected
    assert set(names) < set(RELATIONAL)

    found = replace(comparison(("MRR", True, -0.1, 0.1)), unmeasured=names)
    monkeypatch.setattr(gate, "compare", lambda *_, **__: found)
    run, scenes = SimpleNamespace(config=None), SimpleNamespace(digests={})
    ask = partial(
        *(gate.judge, run, scenes, None, holder, Path()), margin=0.02, limit=None, say=print
    )
    if not names:
        assert ask() is found
        return
    with pytest.raises(WorseError) as refused:
        ask()
    assert "nothing shows how new does at T1a relations, T3b placement" in str(refused.value)
    assert "worse" not in str(refused.value)


def test_an_alias_serves_a_model_or_nothing_that_can_be_compared_with(tmp_path) -> None:
    store = Store(make_store(tmp_path / "store"))
    found = seat(store, "default")
    assert found.holder is not None
    assert (found.holder.title, found.note) == ("home@1.0.0", "")
    assert found.holder.config is None  # random weights do not say how they were trained
    new = seat(store, "fresh")
    assert (new.target, new.holder) == (None, None)
    assert "nothing is served as fresh yet" in new.note
    corrupt(store.root, "home", "1.0.0")
    broken = seat(store, "default")
    assert str(broken.target) == "home@1.0.0"
    assert broken.holder is None
    assert "cannot be read" in broken.note
