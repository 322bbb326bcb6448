"""Models in memory, for calibration and validation, and where their objects stand."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from jaxtyping import Float
from numpy.typing import NDArray

from app.model import Calibration, Places, SceneModel
from app.scene import RoleCounts, Vocabulary
from training.datasets import EncodedScene
from training.datasets.batches import TrainingData
from training.machines import BoltzmannMachine, weights_of


@torch.no_grad()
def as_stored(machine: BoltzmannMachine) -> BoltzmannMachine:
    """Round the weight matrices to half precision, the precision of the store, in place."""
    for parameter in machine.parameters():
        if parameter.dim() > 1:
            parameter.copy_(parameter.half().float())
    return machine.requires_grad_(False).eval()


def draft_artifact(
    machine: BoltzmannMachine, vocabulary: Vocabulary, places: Places | None = None
) -> SceneModel:
    """Return a model in memory, without files. Its calibration leaves log-odds as is."""
    calibration = Calibration.neutral(machine.spec.A)
    return SceneModel(weights_of(machine), vocabulary, calibration, places=places)


def placed_draft(machine: BoltzmannMachine, data: TrainingData) -> SceneModel:
    """Return a machine in half precision, with the places of the training scenes."""
    places = data.roles and fit_places(data.train.scenes, data.roles, data.vocabulary)
    return draft_artifact(as_stored(machine), data.vocabulary, places)


# Weight of the parent of a class, and of all classes, in objects.
_OF_PARENT, _OF_ALL = 5.0, 5.0


def fit_places(
    scenes: Sequence[EncodedScene], roles: RoleCounts, vocabulary: Vocabulary
) -> Places | None:
    """Count the relations between things of two classes. Return None without any relation."""
    V, is_thing = len(vocabulary), ~vocabulary.structure
    blocks, listed = [np.zeros(0, np.int64)], np.ones(V)
    for scene in scenes:
        evidence = scene.evidence
        listed[evidence.classes] += 1
        relation, subject, anchor = np.nonzero(evidence.holds)
        i, j = evidence.classes[subject], evidence.classes[anchor]
        counted = is_thing[i] & is_thing[j] & (i != j)
        blocks.append(((relation * V + i) * V + j)[counted])  # one key for each triple
    keys, scene_counts = np.unique(np.concatenate(blocks), return_counts=True)
    if not len(keys):
        return None
    return Places(
        triple=keys.astype(np.int32),
        triple_scenes=scene_counts.astype(np.float32),
        frequency=(listed / listed.sum()).astype(np.float32),
        role_pair=roles.pair.astype(np.int32),
        role_counts=roles.counts,
        role_anchor=roles.anchor,
        stands=_stands(scenes, vocabulary).astype(np.float32),
    )


def _stands(scenes: Sequence[EncodedScene], vocabulary: Vocabulary) -> Float[NDArray, "V 3"]:
    """Return frequencies of floor, wall and supports, smoothed to the parent and to all."""
    counts = np.zeros((len(vocabulary), 3))
    for scene in scenes:
        observed = scene.instance_stands >= 0
        np.add.at(counts, (scene.instance_classes[observed], scene.instance_stands[observed]), 1)
    overall, totals = counts.sum(0) + 1, counts.sum(1, keepdims=True)
    smoothed = (counts + _OF_ALL * overall / overall.sum()) / (totals + _OF_ALL)
    parents = vocabulary.parents
    prior = np.where((parents >= 0)[:, None], smoothed[parents], overall / overall.sum())
    weight = np.where(parents >= 0, _OF_PARENT, _OF_ALL)[:, None]
    return (counts + weight * prior) / (totals + weight)
