"""Baselines that the benchmark trains on the same scenes as the models.

The baselines treat a class that a source never mentions as absent from the scenes of this source.
Our training objective does the same. If such classes are left out of the fit, the validation MRR of
the baselines falls: EASE .398 to .381, denoising autoencoder .397 to .335, popularity .152 to .145.
The reason is that a score does not know the source and has to rank all classes.
"""

from __future__ import annotations

from typing import Any, Final

from training.baselines import fitting, networks, objects, relations
from training.baselines.fitting import Baseline, Fitted, Trial
from training.evaluation.missing import PlacedScore

RELATIONS: Final = ("relations", "placement")
"""Fields of `Contender` that hold a relation score without observed relations."""

_EVERY: tuple[Baseline[Any], ...] = (
    Baseline("popularity", objects.popularity),
    Baseline("co-occurrence naive Bayes", objects.naive_bayes),
    Baseline("kNN over scenes", objects.nearest),
    Baseline("EASE", objects.ease),
    Baseline("pairwise logistic", objects.pairwise),
    Baseline("scikit-learn BernoulliRBM", objects.bernoulli_rbm, stochastic=True),
    Baseline("masked transformer", networks.transformer, stochastic=True),
    Baseline("denoising autoencoder", networks.autoencoder, stochastic=True),
    Baseline(
        "autoencoder, heavily masked",
        networks.autoencoder_for_parts,
        fitting.partial_mrr,
        stochastic=True,
    ),
    Baseline("relation popularity", relations.relation_popularity, fitting.r_precision, RELATIONS),
    Baseline("frequency table", relations.frequency_table, fitting.r_precision, RELATIONS),
    Baseline(
        "ComplEx", relations.complex_embedding, fitting.r_precision, RELATIONS, stochastic=True
    ),
    Baseline(
        "frequency table, completing",
        relations.frequency_table,
        fitting.completion_r_precision,
        ("completion",),
    ),
    Baseline(
        "frequency table + closure, completing",
        relations.frequency_table_with_closure,
        fitting.completion_r_precision,
        ("completion",),
    ),
    Baseline(
        "frequency table p(i | a, j)", relations.placed_table, fitting.placed_mrr, ("placed",)
    ),
    Baseline(
        "pairwise, by likelihood",
        objects.pairwise_densities,
        fitting.log_likelihood,
        ("density",),
    ),
)

BASELINES: Final[dict[str, Baseline[Any]]] = {entry.name: entry for entry in _EVERY}
"""Baselines by row name."""

PLACED: Final = BASELINES["frequency table p(i | a, j)"]


def placed_product(name: str, score: Any, table: Any) -> Baseline[PlacedScore]:
    """Return a baseline of task T2-at: an object score times the table of `PLACED`, both fitted."""
    propose = relations.times(score, table)
    return Baseline(f"{PLACED.name} × {name}", propose, fitting.placed_mrr, ("placed",))


__all__ = ["BASELINES", "PLACED", "RELATIONS", "Baseline", "Fitted", "Trial", "placed_product"]
