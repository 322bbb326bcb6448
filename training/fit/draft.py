"""Models in memory, for calibration and validation, and where their objects stand."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Sequence
from typing import Final

import numpy as np
import torch
from jaxtyping import Float
from numpy.typing import NDArray

from app.model import Calibration, Places, Possibility, SceneModel
from app.model.possibility import CONTAINER
from app.scene import RoleCounts, Vocabulary
from app.scene.spatial_relations import SUPPORTS
from app.scene.stands import FLOOR, HANGS, SUPPORTED
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
    machine: BoltzmannMachine,
    vocabulary: Vocabulary,
    places: Places | None = None,
    possibility: Possibility | None = None,
) -> SceneModel:
    """Return a model in memory, without files. Its calibration leaves log-odds as is."""
    calibration = Calibration.neutral(machine.spec.A)
    weights = weights_of(machine)
    return SceneModel(weights, vocabulary, calibration, places=places, possibility=possibility)


def placed_draft(machine: BoltzmannMachine, data: TrainingData) -> SceneModel:
    """Return a machine in half precision, with the places of the training scenes."""
    prior = data.possibility
    places = data.roles and fit_places(data.train.scenes, data.roles, data.vocabulary, prior)
    return draft_artifact(as_stored(machine), data.vocabulary, places, prior)


# Weight of the description of a class, of its parent, and of all classes, in objects.
_OF_DESCRIPTION, _OF_PARENT, _OF_ALL = 10.0, 5.0, 5.0


def fit_places(
    scenes: Sequence[EncodedScene],
    roles: RoleCounts,
    vocabulary: Vocabulary,
    possibility: Possibility | None = None,
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
        stands=_stands(scenes, vocabulary, possibility).astype(np.float32),
        within=_within(scenes, V, possibility).astype(np.float32),
    )


def _stands(
    scenes: Sequence[EncodedScene], vocabulary: Vocabulary, possibility: Possibility | None
) -> Float[NDArray, "V 3"]:
    """Return shares of floor, wall and supports, smoothed to the description, or to the parent."""
    counts = np.zeros((len(vocabulary), 3))
    # Words hardly ever state the floor or the wall. Only sources that show all stands count.
    shown: defaultdict[str, set[int]] = defaultdict(set)
    for scene in scenes:
        shown[scene.source].update(scene.instance_stands.tolist())
    complete = {source for source, stands in shown.items() if {FLOOR, HANGS, SUPPORTED} <= stands}
    for scene in scenes:
        if scene.source not in complete:
            continue
        observed = scene.instance_stands >= 0
        np.add.at(counts, (scene.instance_classes[observed], scene.instance_stands[observed]), 1)
    overall, totals = counts.sum(0) + 1, counts.sum(1, keepdims=True)
    smoothed = (counts + _OF_ALL * overall / overall.sum()) / (totals + _OF_ALL)
    parents = vocabulary.parents
    prior = np.where((parents >= 0)[:, None], smoothed[parents], overall / overall.sum())
    weight = np.where(parents >= 0, _OF_PARENT, _OF_ALL)[:, None]
    if possibility is not None:
        described = possibility.is_described[:, None]
        prior = np.where(described, possibility.holders, prior)
        weight = np.where(described, _OF_DESCRIPTION, weight)
    return (counts + weight * prior) / (totals + weight)


_DEPTH: Final = 0.1  # depth in metres below a top from which an object is within its supporter
_OF_CONTAINERS, _OF_OTHERS = 0.75, 0.15  # share of such objects without counts, for containers


def _within(
    scenes: Sequence[EncodedScene], V: int, possibility: Possibility | None
) -> Float[NDArray, " V"]:
    """Return the shares of objects within their supporters, smoothed by the descriptions."""
    counts = np.zeros((V, 2))
    for scene in scenes:
        if scene.instance_positions is None or scene.instance_sizes is None:
            continue
        middle, half = scene.instance_positions[:, 2], scene.instance_sizes[:, 2] / 2
        holds = np.any(scene.instance_holds[[*SUPPORTS]], axis=0)
        i, j = np.nonzero(holds)
        depth = (middle + half)[j] - (middle - half)[i]
        known = np.isfinite(depth)
        classes = scene.instance_classes[j][known]
        np.add.at(counts, (classes, (depth[known] > _DEPTH).astype(int)), 1)
    container = np.zeros(V)
    if possibility is not None:
        container = np.maximum(possibility.traits[:, CONTAINER], 0.0)
    prior = _OF_OTHERS + (_OF_CONTAINERS - _OF_OTHERS) * container
    shares: Float[NDArray, " V"] = (counts[:, 1] + _OF_ALL * prior) / (counts.sum(1) + _OF_ALL)
    return shares
