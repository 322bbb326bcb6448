"""The baselines that comparisons and the gate use as references.

The baselines are the class frequencies, EASE, and frequency tables for relations and places.
`training.research.baselines` has further baselines.

Baselines for objects learn from the same scenes as a machine: with its weights of scenes, without
structure, and without classes that a data source cannot show. They are selected by the same
`validation_score`.
"""

from __future__ import annotations

from typing import Final

from training.evaluation.baselines import classes, fitting, triples
from training.evaluation.baselines.fitting import Baseline
from training.evaluation.model import Model

RELATIONS: Final = ("relations", "false_relations")
"""Fields of `Model` for relation scores that use no observed relations."""

POPULARITY: Final = Baseline("popularity", classes.popularity)
EASE: Final = Baseline("EASE", classes.ease)
FREQUENCY_TABLE: Final = Baseline(
    "frequency table", triples.frequency_table, fitting.relation_precision, RELATIONS
)
PLACED: Final = Baseline(
    "frequency table p(i | a, j)", triples.placed_table, fitting.placed_mrr, ("at_place",)
)


def placed_product(name: str, objects: Model, table: Model) -> Baseline:
    """Return the baseline of T2-at that multiplies a score of missing objects by `PLACED`."""
    propose = triples.times(objects.missing, table.at_place)
    return Baseline(f"{PLACED.name} × {name}", propose, fitting.placed_mrr, ("at_place",))
