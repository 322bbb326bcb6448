"""A machine that is not published yet, as the artifact that calibration and evaluation ask."""

from __future__ import annotations

from pathlib import Path

import torch

from app.inference.posterior import ClosedForm
from app.registry import Artifact, Calibration, Offsets
from app.scene import Vocabulary
from training.machines import BoltzmannMachine
from training.machines.arrays import weights_of
from training.oracle.drawn import DrawnPosterior


@torch.no_grad()
def as_stored(machine: BoltzmannMachine) -> BoltzmannMachine:
    """The machine, its matrices rounded to half precision in place, as the store keeps them."""
    for parameter in machine.parameters():
        if parameter.dim() > 1:
            parameter.copy_(parameter.half().float())
    return machine.requires_grad_(False).eval()


def draft_artifact(
    machine: BoltzmannMachine,
    vocabulary: Vocabulary,
    calibration: Calibration | None = None,
    offsets: Offsets | None = None,
) -> Artifact:
    """An artifact in memory alone, with the neutral calibration unless one is given."""
    return Artifact(
        manifest=None,  # type: ignore[arg-type]  # nothing that answers a question looks at it
        weights=weights_of(machine),
        vocabulary=vocabulary,
        calibration=calibration or Calibration.neutral(machine.spec.A),
        digest="",
        card="",
        path=Path(),
        offsets=offsets,
        oracle=None if ClosedForm.fits(weights_of(machine)) else DrawnPosterior,
    )
