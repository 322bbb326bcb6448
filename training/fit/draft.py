"""Models in memory, for calibration and validation."""

from __future__ import annotations

from pathlib import Path

import torch

from app.registry import Artifact, Calibration, Places
from app.scene import Vocabulary
from training.datasets.batches import TrainingData
from training.fit.place_statistics import fit_places
from training.machines import BoltzmannMachine
from training.machines.arrays import weights_of


@torch.no_grad()
def as_stored(machine: BoltzmannMachine) -> BoltzmannMachine:
    """Round the weight matrices to half precision, the precision of the store, in place."""
    for parameter in machine.parameters():
        if parameter.dim() > 1:
            parameter.copy_(parameter.half().float())
    return machine.requires_grad_(False).eval()


def draft_artifact(
    machine: BoltzmannMachine, vocabulary: Vocabulary, places: Places | None = None
) -> Artifact:
    """Return a model in memory, without files. Its calibration leaves log-odds as is."""
    return Artifact(
        manifest=None,  # type: ignore[arg-type]  # questions never read it
        weights=weights_of(machine),
        vocabulary=vocabulary,
        calibration=Calibration.neutral(machine.spec.A),
        digest="",
        card="",
        path=Path(),
        places=places,
    )


def placed_draft(machine: BoltzmannMachine, data: TrainingData) -> Artifact:
    """Return a machine in half precision, with the places of the training scenes."""
    places = data.roles and fit_places(data.train.scenes, data.roles, data.classes)
    return draft_artifact(as_stored(machine), data.classes, places)
