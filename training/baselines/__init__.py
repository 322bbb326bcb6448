"""Baselines that the benchmark trains on the same scenes as the models.

A class that a data source never mentions counts as absent in all scenes of this source, as in our
training objective. If the fit leaves such classes out, the validation MRR (mean reciprocal rank)
falls: from .398 to .381 for EASE, from .397 to .335 for the denoising autoencoder, and from .152 to
.145 for popularity. The reason is that a score must rank all classes without knowing the source.

`v` is the presence of classes in the training scenes, (scenes, classes), and `structure` a mask of
structure classes such as walls, (classes,) bool.
"""

from __future__ import annotations

from typing import Any, Final

from training.baselines import fitting, networks, objects, relations
from training.baselines.fitting import Baseline, Fitted, Trial
from training.evaluation.missing import PlacedScore

RELATIONS: Final = ("relations", "placement")
"""Fields of `Contender` for relation scores that use no observed relations."""

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
"""Maps the row name of each baseline in the result tables to the baseline."""

PLACED: Final = BASELINES["frequency table p(i | a, j)"]


def placed_product(name: str, score: Any, table: Any) -> Baseline[PlacedScore]:
    """Return the baseline of T2-at whose score is the product of a fitted score and `PLACED`."""
    propose = relations.times(score, table)
    return Baseline(f"{PLACED.name} × {name}", propose, fitting.placed_mrr, ("placed",))


__all__ = ["BASELINES", "PLACED", "RELATIONS", "Baseline", "Fitted", "Trial", "placed_product"]
