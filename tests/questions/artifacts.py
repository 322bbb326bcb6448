"""Small artifacts for tests of the questions. Every test uses each machine of this module."""

from __future__ import annotations

from pathlib import Path

import torch

from app.registry.artifact import Artifact
from app.registry.description import (
    KINDS,
    AlarmLine,
    AlarmLines,
    Calibration,
    CountSlope,
    Judgement,
    Misplaced,
)
from app.scene import ObjectClass, Scene, SceneObject, Vocabulary
from tests.enumeration.small_machines import SMALL
from training.machines import BoltzmannMachine, MachineSpec, build
from training.machines.arrays import weights_of

# Few enough states to enumerate, with one hidden layer and three classes.
EXACT: dict[str, MachineSpec] = {
    name: SMALL[name]
    for name in ("rbm", "rbm-states", "gbm-one-layer", "triway-states", "triway-implications")
}
# Too large to enumerate, with structure and four relations.
LARGER: dict[str, MachineSpec] = {
    "rbm": MachineSpec("rbm", V=9, A=4, units=6, T=40, C=2),
    "gbm": MachineSpec("gbm", V=9, A=4, units=6, H2=3, T=40),
    "triway": MachineSpec("triway", V=9, A=4, units=6, H2=3, K=3, T=5, C=2, profiles=2),
    "triway-states": MachineSpec(
        "triway", V=9, A=4, units=5, states=4, K=3, T=60, C=2, profiles=2, coupled=True
    ),
    "triway-implications": MachineSpec("triway", V=9, A=4, units=6, H2=3, K=3, T=5, C=2, G=2),
}
LABELS = ("bed", "lamp", "desk", "chair", "sofa", "vase", "shelf", "rug", "wall")
STRUCTURE = {"wall"}
ROOMS = ("bedroom", "office", "kitchen")


def lines(low: float, medium: float, high: float, log_count: float = 0.0) -> AlarmLines:
    """Alarm lines with these intercepts and one slope."""
    levels = {"low": low, "medium": medium, "high": high}
    return AlarmLines(
        **{name: AlarmLine(intercept=z, log_count=log_count) for name, z in levels.items()}
    )


NO_ALARM = lines(1e3, 1e3, 1e3)
UNLIKELY = Judgement(intercept=0.0, relation=-1.0, change=-1.0, stand=-1.0, lines=NO_ALARM)


def calibration(relations: int, **changes: object) -> Calibration:
    """A neutral calibration without outliers, so every generated scene is plausible."""
    judging = {
        "outlier": CountSlope(slope=-1.0),
        "outlier_lines": NO_ALARM,
        "misplaced": Misplaced(**dict.fromkeys(KINDS, UNLIKELY)),
    }
    return Calibration(**{**dict(Calibration.neutral(relations)), **judging, **changes})


def artifact_of(machine: BoltzmannMachine, **changes: object) -> Artifact:
    """An artifact with a neutral calibration, except for the changed fields."""
    spec = machine.spec
    vocabulary = Vocabulary(
        [ObjectClass(label, structure=label in STRUCTURE) for label in LABELS[: spec.V]],
        ROOMS[: spec.C],
    )
    return Artifact(
        manifest=None,
        weights=weights_of(machine),
        vocabulary=vocabulary,
        calibration=calibration(spec.A, **changes),
        digest="",
        card="",
        path=Path(),
    )


def larger_artifact(name: str, scale: float = 0.7, **changes: object) -> Artifact:
    """An artifact with many states. All weights are random numbers from N(0, scale²).

    Structure has no object weights, as in a trained machine.
    """
    machine = random_machine(LARGER[name], scale)
    structure = [k for k, label in enumerate(LABELS) if label in STRUCTURE]
    for weights, parameter in machine.named_parameters():
        if weights in ("W", "L"):
            parameter[structure] = 0
    machine.a[:, structure] = 0
    if machine.spec.coupled:
        machine.L[:, structure] = 0
        machine.Y[:, structure] = 0
    return artifact_of(machine, **changes)


def random_machine(spec: MachineSpec, scale: float) -> BoltzmannMachine:
    """A machine with symmetric couplings, as the service has them."""
    generator = torch.Generator().manual_seed(3)
    machine = build(spec)
    if spec.T:
        units = spec.A * spec.V**2
        keys = torch.randperm(units, generator=generator)[: spec.T].sort().values
        machine.set_triples(
            torch.stack([keys // spec.V**2, keys // spec.V % spec.V, keys % spec.V], 1)
        )
    with torch.no_grad():
        for parameter in machine.parameters():
            noise = torch.randn(parameter.shape, generator=generator, dtype=torch.float64)
            parameter.copy_(noise * scale)
        if spec.coupled:
            machine.L.copy_(machine.couplings)
    return machine.eval().requires_grad_(False)


def scene_of(
    classes: list[int],
    relations: list[tuple[int, int, int]] | None = None,
    room: int | None = None,
    *,
    complete: bool = False,
    profile: int | None = None,
) -> Scene:
    """A scene. The relations are canonical triples of a relation and two indices of objects."""
    objects = tuple(SceneObject(f"{LABELS[c]}_{k}", LABELS[c], c) for k, c in enumerate(classes))
    triples = None if relations is None else tuple(relations)
    return Scene(objects, triples, complete, room, profile=profile)
