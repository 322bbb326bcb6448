"""Small artifacts for tests of the questions. Every test uses each machine of this module."""

from __future__ import annotations

from pathlib import Path

import torch

from app.inference.posterior import ClosedForm
from app.registry.artifact import Artifact
from app.registry.description import NEVER, Calibration, CountSlope, Slope
from app.scene import ObjectClass, Scene, SceneObject, Vocabulary
from tests.enumeration.small_machines import SMALL
from training.fit.oracle.drawn import DrawnPosterior
from training.machines import BoltzmannMachine, MachineSpec, build
from training.machines.arrays import weights_of

# Few enough states to enumerate.
EXACT: dict[str, MachineSpec] = {
    "rbm": SMALL["rbm-three-classes"],
    "gbm": SMALL["gbm-one-layer"],
    "triway-seed": MachineSpec("triway", V=3, A=1, H1=2, K=2, T=2, form="seed"),
    "triway-local": MachineSpec("triway", V=3, A=1, H1=3, K=2, T=2, C=2, form="local"),
    "triway-implications": MachineSpec("triway", V=3, A=1, H1=3, K=2, T=2, C=2, G=2, form="local"),
}
# Too large to enumerate. With structure, four relations and two layers.
LARGER: dict[str, MachineSpec] = {
    "rbm": MachineSpec("rbm", V=9, A=4, H1=6, T=40, C=2, form="local"),
    "gbm": MachineSpec("gbm", V=9, A=4, H1=6, H2=3, T=40, form="local"),
    "triway-seed": MachineSpec("triway", V=9, A=4, H1=6, H2=3, K=3, T=5, form="seed"),
    "triway-local": MachineSpec("triway", V=9, A=4, H1=6, H2=3, K=3, T=5, C=2, form="local"),
    # Wide enough for nearly normal logits, so the closed form is exact without relations.
    "triway-wide": MachineSpec("triway", V=9, A=4, H1=90, K=3, T=60, C=2, G=2, form="local"),
    "triway-deep": MachineSpec("triway", V=9, A=4, H1=90, H2=20, K=3, T=60, C=2, form="local"),
    "rbm-wide": MachineSpec("rbm", V=9, A=4, H1=90, T=200, C=2, form="local"),
    "gbm-wide": MachineSpec("gbm", V=9, A=4, H1=90, H2=20, T=200, C=2, form="local"),
    "triway-implications": MachineSpec(
        "triway", V=9, A=4, H1=6, H2=3, K=3, T=5, C=2, G=2, form="local"
    ),
}
LABELS = ("bed", "lamp", "desk", "chair", "sofa", "vase", "shelf", "rug", "wall")
STRUCTURE = {"wall"}
ROOMS = ("bedroom", "office")


def calibration(relations: int, **changes: object) -> Calibration:
    """A neutral calibration without outliers, so every generated scene is plausible."""
    line = {"outlier": CountSlope(slope=-1.0), "misplaced": Slope(intercept=0.0, slope=-1.0)}
    never = {"outlier_thresholds": NEVER, "misplaced_thresholds": NEVER}
    return Calibration(**{**dict(Calibration.neutral(relations)), **line, **never, **changes})


def artifact_of(machine: BoltzmannMachine, **changes: object) -> Artifact:
    """An artifact with a neutral calibration, except for the changed fields."""
    spec, weights = machine.spec, weights_of(machine)
    vocabulary = Vocabulary(
        [ObjectClass(label, structure=label in STRUCTURE) for label in LABELS[: spec.V]],
        ROOMS[: spec.C],
    )
    return Artifact(
        manifest=None,
        weights=weights,
        vocabulary=vocabulary,
        calibration=calibration(spec.A, **changes),
        digest="",
        card="",
        path=Path(),
        oracle=None if ClosedForm.supports(weights) else DrawnPosterior,
    )


def exact_artifact(name: str, scale: float = 1.3, **changes: object) -> Artifact:
    """An artifact in float64. All weights are random numbers from N(0, scale²)."""
    return artifact_of(random_machine(EXACT[name], torch.float64, scale), **changes)


def larger_artifact(name: str, scale: float = 0.7, **changes: object) -> Artifact:
    """An artifact in float32. All weights are random numbers from N(0, scale²)."""
    return artifact_of(random_machine(LARGER[name], torch.float32, scale), **changes)


def random_machine(spec: MachineSpec, dtype: torch.dtype, scale: float) -> BoltzmannMachine:
    generator = torch.Generator().manual_seed(3)
    machine = build(spec).to(dtype)
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
        if hasattr(machine, "kappa"):
            machine.kappa.zero_()
    return machine.eval().requires_grad_(False)


def scene_of(
    classes: list[int],
    relations: list[tuple[int, int, int]] | None = None,
    room: int | None = None,
    *,
    complete: bool = False,
) -> Scene:
    """A scene. The relations are canonical triples of a relation and two indices of objects."""
    objects = tuple(SceneObject(f"{LABELS[c]}_{k}", LABELS[c], c) for k, c in enumerate(classes))
    triples = None if relations is None else tuple(relations)
    return Scene(objects, triples, complete, room)
