"""Baselines that an evaluation trains in the same run, on the same scenes.

`OBJECTS` are scored on T2 and T3, `RELATIONS` on T1a and T3b, `COMPLETIONS` on T1b, `PLACED` on
T2-at and `DENSITIES` on Density; the scores have the types of `training.evaluation`. Each is a
`Baseline`, whose `fit` tunes it on validation and returns every trial.

A class that a source never mentions counts as absent from its scenes, as in our own objective: a
score is not told the source and has to rank all classes. Leaving such classes out weakens a
baseline (validation MRR: EASE .398 to .381, denoising autoencoder .397 to .335, popularity .152 to
.145).
"""

from __future__ import annotations

from typing import Final

from training.baselines import (
    bernoulli_rbm,
    closure,
    complex_embedding,
    denoising,
    ease,
    frequency_table,
    naive_bayes,
    nearest,
    pairwise,
    placed_table,
    popularity,
    relation_popularity,
    transformer,
)
from training.baselines.fitting import Baseline, Fitted, Trial
from training.baselines.judges import (
    completion_r_precision,
    log_likelihood,
    missing_mrr,
    partial_mrr,
    placed_mrr,
    r_precision,
)
from training.baselines.placed_table import PlacedTable
from training.evaluation.density import ObjectDensity
from training.evaluation.missing import ObjectScore
from training.evaluation.placed import PlacedScore
from training.evaluation.relations import RelationScore

OBJECTS: Final[tuple[Baseline[ObjectScore], ...]] = (
    Baseline("popularity", popularity.propose, missing_mrr),
    Baseline("co-occurrence naive Bayes", naive_bayes.propose, missing_mrr),
    Baseline("kNN over scenes", nearest.propose, missing_mrr),
    Baseline("EASE", ease.propose, missing_mrr),
    Baseline("pairwise logistic", pairwise.propose, missing_mrr),
    Baseline("scikit-learn BernoulliRBM", bernoulli_rbm.propose, missing_mrr, stochastic=True),
    Baseline("masked transformer", transformer.propose, missing_mrr, stochastic=True),
    Baseline("denoising autoencoder", denoising.propose, missing_mrr, stochastic=True),
    Baseline(
        "autoencoder, heavily masked", denoising.propose_for_parts, partial_mrr, stochastic=True
    ),
)

RELATIONS: Final[tuple[Baseline[RelationScore], ...]] = (
    Baseline("relation popularity", relation_popularity.propose, r_precision),
    Baseline("frequency table", frequency_table.propose, r_precision),
    Baseline("ComplEx", complex_embedding.propose, r_precision, stochastic=True),
)

# These see the given relations of a batch, and are for T1b alone.
COMPLETIONS: Final[tuple[Baseline[RelationScore], ...]] = (
    Baseline("frequency table", frequency_table.propose, completion_r_precision),
    Baseline("frequency table + closure", closure.propose, completion_r_precision),
)

PLACED: Final[tuple[Baseline[PlacedScore], ...]] = (
    Baseline("frequency table p(i | a, j)", placed_table.propose, placed_mrr),
)

DENSITIES: Final[tuple[Baseline[ObjectDensity], ...]] = (
    Baseline("pairwise, by likelihood", pairwise.propose_densities, log_likelihood),
)


def placed_product(objects: Fitted[ObjectScore], table: PlacedTable) -> Baseline[PlacedScore]:
    """The T2-at row of a fitted object baseline times the fitted table."""
    name = f"frequency table p(i | a, j) × {objects.name}"
    return Baseline(name, placed_table.times(objects.score, table), placed_mrr)


__all__ = [
    "COMPLETIONS",
    "DENSITIES",
    "OBJECTS",
    "PLACED",
    "RELATIONS",
    "Baseline",
    "Fitted",
    "Trial",
    "placed_product",
]
