"""Baselines that the benchmark trains on the same scenes as the models."""

from __future__ import annotations

from typing import Final

from training.evaluation.baselines import (
    EASE,
    FREQUENCY_TABLE,
    PLACED,
    POPULARITY,
    RELATIONS,
    fitting,
    triples,
)
from training.evaluation.baselines.fitting import Baseline
from training.evaluation.room_task import mean_log_p
from training.research.baselines import (
    networks,
    object_models,
    relation_models,
    room_models,
    supporters,
)

_EVERY: tuple[Baseline, ...] = (
    POPULARITY,
    Baseline("co-occurrence naive Bayes", object_models.naive_bayes),
    Baseline("kNN over scenes", object_models.nearest),
    EASE,
    Baseline("pairwise logistic", object_models.pairwise),
    Baseline("scikit-learn BernoulliRBM", object_models.bernoulli_rbm, stochastic=True),
    Baseline("denoising autoencoder", networks.autoencoder, stochastic=True),
    Baseline("most common room type", room_models.most_common, mean_log_p, ("rooms",)),
    Baseline("naive Bayes of rooms", room_models.naive_bayes, mean_log_p, ("rooms",)),
    Baseline(
        "relation popularity",
        relation_models.relation_popularity,
        fitting.relation_precision,
        RELATIONS,
    ),
    FREQUENCY_TABLE,
    Baseline(
        *("ComplEx", relation_models.complex_embedding, fitting.relation_precision, RELATIONS),
        stochastic=True,
    ),
    Baseline(
        "frequency table, completing",
        triples.frequency_table,
        fitting.completion_precision,
        ("completion",),
    ),
    Baseline(
        "frequency table + closure, completing",
        relation_models.frequency_table_with_closure,
        fitting.completion_precision,
        ("completion",),
    ),
    PLACED,
    Baseline(
        *("frequency table of supporters", supporters.supporter_table, fitting.named_moved),
        ("misplaced",),
    ),
)

BASELINES: Final[dict[str, Baseline]] = {entry.name: entry for entry in _EVERY}
"""Maps the row name of each baseline in the result tables to the baseline."""
