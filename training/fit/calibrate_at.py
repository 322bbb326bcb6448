"""Fit the answers to `/missing` at a place: which unlisted class stands on the desk?

Two fits determine the entries `at` of the calibration (`app.registry.PlaceFit`):

1. The weights of the relation and of the counts rank the classes. They maximise the likelihood of a
   removed class under a softmax over all absent classes. All data sources have the same weight.
   Relations of stacked objects share their weights, and so do left and front.
2. Intercept and slope turn the score into log-odds. They are fitted to the classes that an answer
   lists, in scenes whose data source also shows that a relation does not hold.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

import numpy as np
import torch
from scipy.optimize import minimize
from scipy.special import logsumexp

from app.questions.placements import Place, place_log_p
from app.questions.posterior import Posterior
from app.registry import Artifact, PlaceFit
from app.scene import Scene
from app.scene.relations import LATERAL, STACKED
from training.datasets import EncodedScene
from training.datasets.array_types import Floats, Ints
from training.datasets.batches import SceneTensors
from training.datasets.cases import RIDGE, logistic
from training.evaluation.asking import instances_of
from training.evaluation.calibration_task import place_question
from training.evaluation.missing_tasks import removed_places
from training.evaluation.model import Places

_QUESTIONS: Final = 80  # maximum questions of each source in the fit of the weights
_LISTED: Final = 10  # classes that an answer lists by default
_LEAST_TRUE: Final = 10  # minimum true examples of a fit of intercept and slope
_ALL_BUT_ONE: Final = 1.0  # coverage of a scene from which one class is removed


def fit_at(artifact: Artifact, scenes: SceneTensors, seed: int = 0) -> tuple[PlaceFit, ...]:
    """Return the entry of each relation. Relations without questions keep the default entry."""
    entries = [PlaceFit()] * artifact.spec.A
    for kind in (LATERAL, STACKED):
        weights = _fit_weights(artifact, scenes, kind, seed)
        entry = _fit_scale(artifact, scenes.scenes, kind, weights, seed)
        for a in kind:
            entries[a] = entry
    return tuple(entries)


def place_terms(
    artifact: Artifact, scene: Scene, place: Place, coverage: float
) -> tuple[Floats, Floats, Floats]:
    """Return the three terms of the score of each class at a place, (V,) each; see `PlaceFit`."""
    posterior, every = Posterior(artifact, scene), np.arange(artifact.spec.V)
    anchor = int(posterior.present.classes[posterior.present.row[place.anchor]])
    ratio = np.zeros(len(every))
    if artifact.places is not None:
        ratio = artifact.places.log_ratio(place.relation, anchor, outgoing=place.outgoing)
    relation = place_log_p(posterior, every, place).astype(np.float64)
    return posterior.absent_log_odds(every, coverage).astype(np.float64), relation, ratio


def _fit_weights(
    artifact: Artifact, scenes: SceneTensors, relations: Sequence[int], seed: int
) -> PlaceFit:
    """Fit the weights of the relation and of the counts to removed classes."""
    structure = torch.from_numpy(artifact.vocabulary.structure.copy())
    row, target, places = removed_places(scenes, structure)
    source = scenes.source[row].numpy()
    usable = np.isin(places.relation.numpy(), relations)
    rng = np.random.default_rng(seed)
    chosen: list[int] = []
    weight: list[float] = []
    for name in np.unique(source[usable]):
        index = rng.permutation(np.flatnonzero(usable & (source == name)))[:_QUESTIONS]
        chosen += index.tolist()
        weight += [1 / len(index)] * len(index)
    if not chosen:
        return PlaceFit()
    terms = [_masked_terms(artifact, places.rows(torch.tensor([k]))) for k in chosen]
    presence, relation, counts = (np.stack(column) for column in zip(*terms, strict=True))
    hidden, rows = target[chosen].numpy(), np.arange(len(chosen))
    share = np.array(weight) / sum(weight)

    def loss(weights: Floats) -> float:
        score = presence + weights[0] * relation + weights[1] * counts
        return float(share @ (logsumexp(score, axis=1) - score[rows, hidden]))

    best = minimize(loss, [0.5, 0.3], bounds=[(0, 1.5), (0, 1.5)]).x.tolist()
    return PlaceFit(relation=best[0], counts=best[1])


def _masked_terms(artifact: Artifact, places: Places) -> tuple[Floats, Floats, Floats]:
    """Return `place_terms` of a place. The presence is -inf for classes that cannot be missing."""
    classes = places.v[0].nonzero().squeeze(1)
    scene, first = instances_of(classes, places.counts[0, classes])
    anchor = int(first[int((classes == places.anchor[0]).nonzero())])
    place = Place(int(places.relation[0]), anchor, bool(places.outgoing[0]))
    presence, relation, counts = place_terms(artifact, scene, place, _ALL_BUT_ONE)
    presence[(places.v[0] > 0).numpy() | artifact.vocabulary.structure] = -np.inf
    return presence, relation, counts


def _fit_scale(
    artifact: Artifact,
    scenes: Sequence[EncodedScene],
    relations: Sequence[int],
    weights: PlaceFit,
    seed: int,
) -> PlaceFit:
    """Fit intercept and slope to the likeliest classes at places in parts of the scenes."""
    rng = np.random.default_rng(seed)
    rows: list[Floats] = []
    for encoded in scenes:
        question = place_question(artifact.vocabulary, encoded, rng, relations)
        if question is None:
            continue
        scene, place, truth, usable = question
        terms = place_terms(artifact, scene, place, artifact.calibration.coverage)
        score = terms[0] + weights.relation * terms[1] + weights.counts * terms[2]
        first: Ints = np.argsort(np.where(usable, -score, np.inf), kind="stable")[:_LISTED]
        rows.append(np.stack([score[first], truth[first]], 1)[usable[first]])
    examples = np.concatenate(rows or [np.zeros((0, 2))])
    holds = examples[:, 1] > 0
    if holds.sum() < _LEAST_TRUE or holds.all():
        return weights
    slope, intercept = logistic(examples[:, :1], holds, C=RIDGE)
    if slope <= 0:
        return weights
    return weights.model_copy(update={"intercept": intercept, "slope": slope})
