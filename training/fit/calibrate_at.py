"""Fit the answers to `/missing` at a place: which unlisted class stands on the desk?

Two fits determine the entries `at` of the calibration (`app.registry.PlaceFit`):

1. The weights of the relation and of the counts rank the classes. They maximise the likelihood of a
   removed class under a softmax over all absent classes, for all data sources with equal weights.
   Relations of stacked objects share their weights, and so do left and front.
2. Intercept and slope turn the score into log-odds. They are fitted to the classes that an answer
   lists, in scenes whose data source also shows that a relation does not hold.
"""

from __future__ import annotations

from typing import Final, NamedTuple

import numpy as np
import torch
from scipy.optimize import minimize

from app.questions.placements import Place, place_log_p
from app.questions.posterior import Posterior
from app.registry import Artifact, PlaceFit
from app.scene import CANONICAL, Scene
from app.scene.relations import STACKED
from training.datasets import EncodedScene
from training.datasets.array_types import Flags, Floats, Rng
from training.datasets.batches import SceneTensors
from training.datasets.cases import RIDGE, logistic
from training.evaluation.asking import of_classes
from training.evaluation.calibration_task import PlaceQuestion, place_question
from training.evaluation.missing_tasks import removed_places
from training.evaluation.setting import some_of

_QUESTIONS = 150  # maximum questions of each source in the fit of the weights
_LISTED = 10  # classes that an answer lists by default
_LEAST_EXAMPLES = 20
_KINDS: Final = (
    tuple(a for a in range(len(CANONICAL)) if a not in STACKED),
    tuple(STACKED),
)


class _Scores(NamedTuple):
    """The three terms of the score of each class, (V,); see `PlaceFit`."""

    presence: Floats
    relation: Floats
    counts: Floats

    def of(self, entry: PlaceFit) -> Floats:
        score: Floats = self.presence + entry.relation * self.relation + entry.counts * self.counts
        return score
