from __future__ import annotations

from dataclasses import replace
from functools import partial
from pathlib import Path
from types import SimpleNamespace

import pytest

from app.registry import Store
from tests.http.stores import corrupt, make_store
from training.evaluation.metrics import Figure
from training.experiments import gate
from training.experiments.compare import RELATIONAL, Comparison, unmeasured
from training.experiments.gate import WorseError, seat
from training.experiments.results import Difference, Results
from training.experiments.sides import Side


def difference(task: str, metric: str, low: float, high: float) -> Difference:
    return Difference("old", task, "held out", metric, Figure((low + high) / 2, low, high, 9))


def comparison(*rows: tuple[str, str, float, float]) -> Comparison:
    """Of rows (task, metric, low, high)."""
    results = Results("new", (), tuple(difference(*row) for row in rows))
    return Comparison(results, "old", 40, 20, True, (), ())


@pytest.mark.parametrize(
    ("metric", "low", "high", "margin", "worse"),
    [
        ("MRR", -0.20, -0.03, 0.02, True),
        ("MRR", -0.20, -0.03, 0.05, False),  # within the margin
        ("MRR", -0.20, 0.01, 0.02, False),  # may be chance
        ("MRR", -0.20, -0.01, 0.02, False),  # worse for sure, beyond the margin not for sure
        ("top-10", -0.20, -0.10, 0.02, False),  # not the primary metric
        ("MRR", -0.20, -0.01, 0.0, True),
    ],
)
def test_worse_is_what_lies_beyond_the_margin_entirely(metric, low, high, margin, worse) -> None:
    found = comparison(("T2 missing", metric, low, high), ("T2 missing", "top-1", 0.1, 0.2))
    assert [row.metric for row in found.worse_by(margin)] == (["MRR"] if worse else [])


def test_a_refusal_names_every_metric_that_is_worse() -> None:
    found = comparison(
        ("T2 missing", "MRR", -0.3, -0.2),
        ("T3 outliers, uniform", "hit@1", -0.3, -0.1),
        ("T1b completion", "R-precision", 0, 1),
    )
    text = str(WorseError(found, 0.02))
    assert "MRR (-0.250" in text
    assert "hit@1" in text
    assert "R-precision" not in text
    assert found.to_dict()["differences"][0]["verdict"] == "worse"
    assert comparison().worse_by(0) == []


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
    row = difference(task, "MRR", -0.1, 0.1)
    names = unmeasured([row], holder)
    assert len(names) == expected
    assert set(names) < set(RELATIONAL)

    found = replace(comparison(("T2 missing", "MRR", -0.1, 0.1)), unmeasured=names)
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
    assert "old was measured in T1a relations, T3b placement, but new was not" in str(refused.value)
    assert "worse" not in str(refused.value)


def test_an_alias_serves_a_model_or_nothing_that_can_be_compared_with(tmp_path) -> None:
    store = Store(make_store(tmp_path / "store"))
    found = seat(store, "default")
    assert found.holder is not None
    assert (found.holder.title, found.note) == ("home@1.0.0", "")
    assert found.holder.config is None  # random weights do not say how they were trained
    new = seat(store, "fresh")
    assert (new.target, new.holder) == (None, None)
    assert "fresh is a new alias" in new.note
    corrupt(store.root, "home", "1.0.0")
    broken = seat(store, "default")
    assert str(broken.target) == "home@1.0.0"
    assert broken.holder is None
    assert "cannot be read" in broken.note
