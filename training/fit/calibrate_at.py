"""Fit the answers to `/missing` at a place: which unlisted class stands on the desk?

    p(class and place) = p(class) p(place | class)

The first factor is that of `/missing` without a place. The entries `at` of the calibration
(`app.registry.PlaceFit`) give the second, by maximum likelihood of the product over all classes
that may stand at places in parts of scenes. Data sources have equal weights.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Sequence
from typing import Final, NamedTuple

import numpy as np
from jaxtyping import Bool, Float
from numpy.typing import NDArray
from scipy.optimize import minimize

from app.model import PlaceFit, SceneModel
from app.questions.doubt import believed
from app.questions.placements import place_log_p
from app.questions.posterior import calibrated_missing
from app.scene.spatial_relations import LATERAL, STACKED
from training.datasets import EncodedScene
from training.evaluation.calibration_task import PlaceQuestion, place_question

_QUESTIONS: Final = 80  # maximum questions of each source
_LEAST_TRUE: Final = 10  # minimum true examples of a fit
_PENALTY: Final = 1e-3  # of the squared intercept, so that places without objects have a finite fit


class PlaceTerms(NamedTuple):
    """The terms of `PlaceFit` for N classes at a place."""

    present: Float[NDArray, "N"]  # calibrated log-odds that the class is present
    relation: Float[NDArray, "N"]  # term p of `PlaceFit`
    counts: Float[NDArray, "N"]  # term c of `PlaceFit`
    is_there: Bool[NDArray, "N"]  # True if the class is at the place


def fit_at(
    artifact: SceneModel, scenes: Sequence[EncodedScene], seed: int = 0
) -> tuple[PlaceFit, ...]:
    """Return the entry of each relation. Relations with few questions keep the default entry."""
    entries = [PlaceFit()] * artifact.spec.A
    for kind in (LATERAL, STACKED):
        rng = np.random.default_rng(seed)
        terms: dict[str, list[PlaceTerms]] = defaultdict(list)
        for k in rng.permutation(len(scenes)).tolist():
            if len(terms[scenes[k].source]) < _QUESTIONS:
                question = place_question(artifact.vocabulary, scenes[k], rng, kind)
                if question is not None:
                    terms[scenes[k].source].append(place_terms(artifact, question))
        entry = fit_place([of_source for of_source in terms.values() if of_source])
        for a in kind:
            entries[a] = entry
    return tuple(entries)


def place_terms(artifact: SceneModel, question: PlaceQuestion) -> PlaceTerms:
    """Return the terms of the candidate classes at a place."""
    scene, place, is_there, usable = question
    posterior, classes = believed(artifact, scene), np.flatnonzero(usable)
    log_odds = posterior.absent_log_odds(classes, artifact.calibration.coverage).astype(np.float64)
    counts = np.zeros(len(classes))
    if artifact.places is not None:
        anchor = int(posterior.present.classes[posterior.present.row[place.anchor]])
        counts = artifact.places.log_ratio(place.relation, anchor, outgoing=place.outgoing)[classes]
    return PlaceTerms(
        calibrated_missing(artifact.calibration, log_odds, posterior.listed, None).astype(
            np.float64
        ),
        place_log_p(posterior, classes, place).astype(np.float64),
        counts,
        is_there[classes],
    )


def fit_place(sources: Sequence[Sequence[PlaceTerms]]) -> PlaceFit:
    """Fit log P(at the place) = log P(present) + log σ(a + b·relation + c·counts).

    `relation` is the log-probability of the relation by the machine. `counts` is the log of how
    much more often training shows the class at the place than in general. The penalised likelihood
    is maximal. A source has a group of terms for each question. All sources have equal weight.
    """
    columns = [map(np.concatenate, zip(*terms, strict=True)) for terms in sources]
    if not columns:
        return PlaceFit()
    present, relation, counts, is_there = map(np.concatenate, zip(*columns, strict=True))
    if is_there.sum() < _LEAST_TRUE:
        return PlaceFit()
    # The questions of a source have the total weight 1.
    weight = np.concatenate(
        [np.full(sum(len(t.is_there) for t in terms), 1 / len(terms)) for terms in sources]
    )
    log_present = -np.logaddexp(0.0, -present)  # log σ of the log-odds

    def loss(parameters: NDArray[np.float64]) -> float:
        """Return the penalised negative log-likelihood of (a, b, c)."""
        a, b, c = parameters
        log_p = log_present - np.logaddexp(0.0, -(a + b * relation + c * counts))
        log_not = np.log(-np.expm1(np.minimum(log_p, -1e-12)))  # log(1 - p), also for p near 1
        likelihood = weight @ np.where(is_there, log_p, log_not)
        return float(_PENALTY * a**2 - likelihood / len(sources))

    # More evidence never lowers the probability, so b and c are not negative.
    limits = [(None, None), (0, 1.5), (0, 1.5)]
    best = minimize(loss, [0.0, 0.5, 0.3], bounds=limits).x.tolist()
    return PlaceFit(intercept=best[0], relation=best[1], counts=best[2])
