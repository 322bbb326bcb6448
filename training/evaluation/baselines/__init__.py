"""The baselines that comparisons and the gate use as references.

The baselines are the class frequencies, EASE, and frequency tables for relations and places.
`training.research.baselines` has further baselines.

A class that a data source never mentions counts as absent in all scenes of this source, as in our
training objective. If the fit leaves such classes out, the validation MRR (mean reciprocal rank)
falls: from .398 to .381 for EASE, from .397 to .335 for the denoising autoencoder, and from .152 to
.145 for popularity. The reason is that a score must rank all classes without knowing the source.

`v` is the presence of classes in the training scenes, (scenes, classes), and `structure` a mask of
structure classes such as walls, (classes,) bool.
"""

from __future__ import annotations

from typing import Any, Final

from training.evaluation.baselines import classes, fitting, triples
from training.evaluation.baselines.fitting import Baseline
from training.evaluation.model import ObjectScore, PlacedScore, RelationScore

RELATIONS: Final = ("relations", "placement")
"""Fields of `Contender` for relation scores that use no observed relations."""

POPULARITY: Final[Baseline[ObjectScore]] = Baseline("popularity", classes.popularity)
EASE: Final[Baseline[ObjectScore]] = Baseline("EASE", classes.ease)
FREQUENCY_TABLE: Final[Baseline[RelationScore]] = Baseline(
    "frequency table", triples.frequency_table, fitting.r_precision, RELATIONS
)
PLACED: Final[Baseline[PlacedScore]] = Baseline(
    "frequency table p(i | a, j)", triples.placed_table, fitting.placed_mrr, ("placed",)
)


def placed_product(name: str, score: Any, table: Any) -> Baseline[PlacedScore]:
    """Return the baseline of T2-at whose score is the product of a fitted score and `PLACED`."""
    propose = triples.times(score, table)
    return Baseline(f"{PLACED.name} × {name}", propose, fitting.placed_mrr, ("placed",))
