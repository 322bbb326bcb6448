"""The model card: terms, figures and limits of a model."""

from __future__ import annotations

from typing import Any

import pytest

from app.registry.card import render_card
from app.registry.manifest import TensorEntry
from tests.registry.small_artifacts import DATA, FIGURE, SPECS, description

TENSORS = {
    "W": TensorEntry(dtype="float16", shape=(3, 5)),
    "b": TensorEntry(dtype="float32", shape=(3,)),
    "triples": TensorEntry(dtype="int32", shape=(2, 3)),
}


def source(name: str, *, research_only: bool) -> dict[str, Any]:
    changes = {"scenes": 8133, "digest": "cd" * 32, "terms": f"terms of {name}"}
    return DATA | changes | {"source": name, "research_only": research_only}


def card(**changes: Any) -> str:
    return render_card(description(**changes), TENSORS)


def test_names_data_terms_metrics_and_limits() -> None:
    page = card(data=[source("rooms", research_only=False)])
    assert page.startswith("# tiny 1.0.0\n")
    assert "| rooms | 8,133 | terms of rooms | `cdcdcdcdcdcdcdcd…` |" in page
    assert "| missing | MRR | 0.500 [0.400, 0.600] |" in page
    assert "Terms of the weights: Apache-2.0" in page
    assert "18 (stored as float16, float32, int32)" in page
    assert "3, of which 2 may be proposed" in page
    assert "bedroom, office" in page
    # Models of streets have a card as well: what a scene is, the sources say.
    assert "indoor" not in page
    for heading in ("Intended use", "Metrics", "Data and terms", "Limits"):
        assert f"\n## {heading}\n" in page


@pytest.mark.parametrize(
    ("variant", "changes", "rows"),
    [
        (
            "triway",
            {"G": 8, "N": 1024, "T": 17969},
            [
                "Hidden units | 2 units of 4 states",
                "Couplings | between all pairs of classes",
                "Relation weights | factors of rank 2, and own weights of 17,969 triples; "
                "implications of rank 8",
                "Stored scenes | 1,024, where chains start",
                "Profiles | homes, shops",
            ],
        ),
        (
            "gbm",
            {},
            [
                "Hidden units | 5 binary units",
                "Second layer | 2 binary units",
                "Couplings | none",
                "Relation weights | own weights of 2 triples",
                "Stored scenes | none",
                "Profiles | none",
            ],
        ),
    ],
)
def test_sizes_are_in_words(variant: str, changes: dict[str, Any], rows: list[str]) -> None:
    page = card(variant=variant, spec=SPECS[variant] | changes)
    for row in rows:
        assert f"| {row} |\n" in page
    assert ("| Second layer " in page) == (variant == "gbm")


def test_warns_of_research_data_by_name_and_of_no_other() -> None:
    free, bound = source("free", research_only=False), source("bound", research_only=True)
    assert "commercial robot" not in card(data=[free])
    warned = card(data=[free, bound])
    assert "trained on bound, whose" in warned
    assert warned.index("commercial robot") < warned.index("## Model"), "before anything else"


def test_metrics_have_a_column_for_each_source() -> None:
    """Sources that list no relations leave their cells empty."""
    measured = [("T1", "R", "a"), ("T2", "MRR", "a"), ("T2", "MRR", "b"), ("T4", "MMD", "pooled")]
    page = card(metrics=[{"task": t, "metric": m, "source": s} | FIGURE for t, m, s in measured])
    cell = "0.500 [0.400, 0.600]"
    lines = page.splitlines()
    first = lines.index("| Task | Metric | a | b | pooled |")
    assert lines[first + 2 : first + 6] == [
        f"| T1 | R | {cell} |  |  |",
        f"| T2 | MRR | {cell} | {cell} |  |",
        f"| T4 | MMD |  |  | {cell} |",
        "",
    ]
    # What the probabilities are calibrated to stands beside their figures.
    assert "- misplaced: the relation is false" in page


def test_markdown_in_a_source_is_escaped() -> None:
    hostile = source("a|b\n\n# Heading", research_only=True)
    page = card(data=[hostile])
    assert "\n# Heading" not in page
    assert "a\\|b # Heading" in page


def test_a_final_fit_says_that_its_figures_are_of_the_first() -> None:
    assert "second training run" in card(training={"measured_split": "group"})
    assert "second training run" not in card(training={})
