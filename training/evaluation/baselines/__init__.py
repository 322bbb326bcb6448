"""The baselines of comparisons and of the gate; `training.research.baselines` has further ones.

Baselines for objects learn from the same scenes as a machine: with its weights of scenes, without
structure, and without classes that a data source cannot show. They are selected by the same
`validation_score`.
"""

from __future__ import annotations

from typing import Final

from training.evaluation.baselines import classes, triples
from training.evaluation.baselines.fitting import AT_PLACE, RELATIONS, Baseline
from training.evaluation.model import Model

POPULARITY: Final = Baseline("popularity", classes.popularity)
EASE: Final = Baseline("EASE", classes.ease)
FREQUENCY_TABLE: Final = Baseline("frequency table", triples.frequency_table, RELATIONS)
PLACED: Final = Baseline("frequency table p(i | a, j)", triples.placed_table, AT_PLACE)


def placed_product(name: str, objects: Model, table: Model) -> Baseline:
    """Return the baseline of T2-at that multiplies a score of missing objects by `PLACED`."""
    propose = triples.propose_products(objects.missing, table.at_place)
    return Baseline(f"{PLACED.name} × {name}", propose, AT_PLACE)
