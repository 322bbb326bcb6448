"""The model card: terms, figures and limits of a model."""

from __future__ import annotations

from typing import Any

from app.registry.card import render_card
from app.registry.manifest import TensorEntry
from tests.registry.small_artifacts import DATA, FIGURE, SPECS, description

TENSORS = {
    "W": TensorEntry(dtype="float16", shape=(3, 5)),
    "triples": TensorEntry(dtype="int32", shape=(2, 3)),
}


def source(name: str, *, research_only: bool = False) -> dict[str, Any]:
    changes = {"scenes": 8133, "terms": f"terms of {name}"}
    return DATA | changes | {"source": name, "research_only": research_only}


def card(**changes: Any) -> str:
    return render_card(description(**changes), TENSORS)


def test_names_data_terms_sizes_and_limits() -> None:
    spec = SPECS["triway"] | {"G": 8, "N": 1024, "T": 17969}
    page = card(variant="triway", spec=spec, data=[source("rooms")])
    assert page.startswith("# tiny 1.0.0\n")
    for text in (
        *("| rooms | 8,133 | terms of rooms |", "Terms of the weights: Apache-2.0"),
        *("(stored as float16, int32)", "3, of which 2 may be proposed", "bedroom, office"),
        *("2 units of 4 states", "17,969 triples", "1,024, where chains start", "homes, shops"),
        *("\n## Intended use\n", "\n## Limits\n"),
    ):
        assert text in page


def test_warns_of_research_data_by_name_before_anything_else() -> None:
    free, bound = source("free"), source("bound", research_only=True)
    assert "commercial robot" not in card(data=[free])
    warned = card(data=[free, bound])
    assert "trained on bound, whose" in warned
    assert warned.index("commercial robot") < warned.index("## Model")
    assert "second training run" in card(training={"measured_split": "group"})


def test_metrics_have_a_column_for_each_source() -> None:
    """A metric without a value of a source leaves its cell empty."""
    measured = [("T1", "R", "a"), ("T2", "MRR", "a"), ("T2", "MRR", "b"), ("T4", "MMD", "pooled")]
    page = card(metrics=[{"task": t, "metric": m, "source": s} | FIGURE for t, m, s in measured])
    cell = "0.500 [0.400, 0.600]"
    lines = page.splitlines()
    first = lines.index("| Task | Metric | a | b | pooled |")
    assert lines[first + 2 : first + 5] == [
        f"| T1 | R | {cell} |  |  |",
        f"| T2 | MRR | {cell} | {cell} |  |",
        f"| T4 | MMD |  |  | {cell} |",
    ]


def test_markdown_in_a_source_is_escaped() -> None:
    page = card(data=[source("a|b\n\n# Heading", research_only=True)])
    assert "\n# Heading" not in page
    assert "a\\|b # Heading" in page
