"""Baselines that the benchmark trains on the same scenes as the models."""

from __future__ import annotations

from typing import Final

from training.evaluation.baselines import EASE, FREQUENCY_TABLE, PLACED, POPULARITY
from training.evaluation.selection import COMPLETION, MISPLACED, RELATIONS, ROOMS, Baseline
from training.research.baselines import count_models, object_models

_EVERY: tuple[Baseline, ...] = (
    POPULARITY,
    Baseline("co-occurrence naive Bayes", object_models.naive_bayes),
    Baseline("kNN over scenes", object_models.nearest),
    EASE,
    Baseline("pairwise logistic", object_models.pairwise),
    Baseline("scikit-learn BernoulliRBM", object_models.bernoulli_rbm, stochastic=True),
    Baseline("denoising autoencoder", object_models.autoencoder, stochastic=True),
    Baseline("most common room type", count_models.most_common_room, ROOMS),
    Baseline("naive Bayes of rooms", count_models.room_naive_bayes, ROOMS),
    Baseline("relation popularity", count_models.relation_popularity, RELATIONS),
    FREQUENCY_TABLE,
    Baseline("ComplEx", count_models.complex_embedding, RELATIONS, stochastic=True),
    Baseline("frequency table, completing", FREQUENCY_TABLE.propose, COMPLETION),
    Baseline(
        "frequency table + closure, completing",
        count_models.frequency_table_with_closure,
        COMPLETION,
    ),
    PLACED,
    Baseline("frequency table of supporters", count_models.supporter_table, MISPLACED),
)

BASELINES: Final[dict[str, Baseline]] = {entry.name: entry for entry in _EVERY}
"""Maps the row name of each baseline in the result tables to the baseline."""
