"""Fit the answers to `/missing` at a place: which unlisted class stands on the desk?

    p(class and place) = p(class) p(place | class)

The first factor is that of `/missing` without a place. The entries `at` of the calibration give the
second factor (`app.registry.PlaceFit`). They are fitted by maximum likelihood of the product, over
all classes that may stand at places in parts of scenes. Data sources have equal weights. Relations
of stacked objects share an entry, and so do left and front.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Sequence
from typing import Final, NamedTuple

import numpy as np
from scipy.optimize import minimize

from app.model import PlaceFit, SceneModel
from app.questions.placements import place_log_p
from app.questions.posterior import Posterior, calibrated_missing
from app.scene.spatial_relations import LATERAL, STACKED
from training.datasets import EncodedScene
from training.datasets.array_types import Flags, Floats
from training.evaluation.calibration_task import PlaceQuestion, place_question

_QUESTIONS: Final = 80  # maximum questions of each source
_LEAST_TRUE: Final = 10  # minimum true examples of a fit
_PENALTY: Final = 1e-3  # of the squared intercept, so that places without objects have a finite fit


class PlaceTerms(NamedTuple):
    """The terms of `PlaceFit` for N classes at a place, (N,) each.

    Attributes:
        present: calibrated log-odds that the class is present.
        relation, counts: terms p and c of `PlaceFit`.
        placed: True if the class is at the place.
    """

    present: Floats
    relation: Floats
    counts: Floats
    placed: Flags


def fit_at(
    artifact: SceneModel, scenes: Sequence[EncodedScene], seed: int = 0
) -> tuple[PlaceFit, ...]:
    """Return the entry of each relation. Relations with few questions keep the default entry."""
    entries = [PlaceFit()] * artifact.spec.A
    for kind in (LATERAL, STACKED):
        rng = np.random.default_rng(seed)
        questions: dict[str, list[PlaceTerms]] = defaultdict(list)
        for k in rng.permutation(len(scenes)).tolist():
            of_source = questions[scenes[k].source]
            if len(of_source) < _QUESTIONS:
                question = place_question(artifact.vocabulary, scenes[k], rng, kind)
                if question is not None:
                    of_source.append(place_terms(artifact, question))
        entry = fit_place([terms for terms in questions.values() if terms])
        for a in kind:
            entries[a] = entry
    return tuple(entries)


def place_terms(artifact: SceneModel, question: PlaceQuestion) -> PlaceTerms:
    """Return the terms of the classes that may be asked for at a place."""
    scene, place, placed, usable = question
    posterior, classes = Posterior(artifact, scene), np.flatnonzero(usable)
    coverage = artifact.calibration.coverage
    z = posterior.absent_log_odds(classes, coverage).astype(np.float64)
    counts = np.zeros(len(classes))
    if artifact.places is not None:
        anchor = int(posterior.present.classes[posterior.present.row[place.anchor]])
        counts = artifact.places.log_ratio(place.relation, anchor, outgoing=place.outgoing)[classes]
    return PlaceTerms(
        calibrated_missing(artifact.calibration, z, posterior.listed, None).astype(np.float64),
        place_log_p(posterior, classes, place).astype(np.float64),
        counts,
        placed[classes],
    )


def fit_place(sources: Sequence[Sequence[PlaceTerms]]) -> PlaceFit:
    """Return the entry of the largest likelihood, with equal weights of the sources."""
    columns = [map(np.concatenate, zip(*terms, strict=True)) for terms in sources]
    if not columns:
        return PlaceFit()
    present, relation, counts, placed = map(np.concatenate, zip(*columns, strict=True))
    if placed.sum() < _LEAST_TRUE:
        return PlaceFit()
    share = np.concatenate(
        [np.full(sum(len(t.placed) for t in terms), 1 / len(terms)) for terms in sources]
    )
    log_present = -np.logaddexp(0.0, -present)

    def loss(weights: Floats) -> float:
        logits = weights[0] + weights[1] * relation + weights[2] * counts
        log_p = log_present - np.logaddexp(0.0, -logits)
        log_not = np.log(-np.expm1(np.minimum(log_p, -1e-12)))
        likelihood = share @ np.where(placed, log_p, log_not)
        return float(_PENALTY * weights[0] ** 2 - likelihood / len(sources))

    limits = [(None, None), (0, 1.5), (0, 1.5)]
    best = minimize(loss, [0.0, 0.5, 0.3], bounds=limits).x.tolist()
    return PlaceFit(intercept=best[0], relation=best[1], counts=best[2])
