"""Small artifacts for tests of the questions. Every test uses each machine of this module."""

import numpy as np
import torch

from app.model.calibration import (
    KINDS,
    AlarmLine,
    AlarmLines,
    Calibration,
    CountSlope,
    Judgement,
    Misplaced,
)
from app.model.scene_model import SceneModel
from app.model.statistics import Places
from app.scene import ObjectClass, RelationTable, Scene, SceneObject, Vocabulary
from tests.enumeration.small_machines import SMALL, random_weights
from training.machines import BoltzmannMachine, MachineSpec, build, weights_of

# Few enough states to enumerate, with three classes.
EXACT: dict[str, MachineSpec] = {name: spec for name, spec in SMALL.items() if spec.V == 3}
# Too large to enumerate, with structure and five relations.
LARGER: dict[str, MachineSpec] = {
    "rbm": MachineSpec("rbm", V=9, A=5, units=6, T=40, C=2),
    "gbm": MachineSpec("gbm", V=9, A=5, units=6, T=40),
    "triway": MachineSpec("triway", V=9, A=5, units=6, K=3, T=5, C=2, profiles=2),
    "triway-states": MachineSpec(
        "triway", V=9, A=5, units=5, states=4, K=3, T=60, C=2, profiles=2, coupled=True
    ),
    "triway-implications": MachineSpec("triway", V=9, A=5, units=6, K=3, T=5, C=2, G=2),
}
LABELS = ("bed", "lamp", "desk", "chair", "sofa", "vase", "shelf", "rug", "wall")
STRUCTURE = {"wall"}
ROOMS = ("bedroom", "office", "kitchen")


def lines(low: float, medium: float, high: float, log_count: float = 0.0) -> AlarmLines:
    """Alarm lines with these intercepts and one slope."""
    levels = {"low": low, "medium": medium, "high": high}
    return AlarmLines(**{k: AlarmLine(intercept=z, log_count=log_count) for k, z in levels.items()})


NO_ALARM = lines(1e3, 1e3, 1e3)
DOUBTING = CountSlope(slope=-1.0)
"""Every unlikely object is a probable intruder."""


def judging(lines: AlarmLines = NO_ALARM, stand: float = 0.0, **changes: object) -> Misplaced:
    """The judgement of every kind by the log-odds of the relation. Changes replace judgements."""
    weights = {"relation": -1.0, "change": -1.0, "stand": stand, "unknown": -1.0}
    judgement = Judgement(intercept=0.0, supporter=0.0, entries=0.0, lines=lines, **weights)
    return Misplaced(**{**dict.fromkeys(KINDS, judgement), **changes})


def calibration(relations: int, **changes: object) -> Calibration:
    """A neutral calibration without outliers, so every generated scene is plausible.

    No object is doubtful: the log-odds of an intruder are below -100.
    """
    outlier = CountSlope(intercept=-200.0, slope=-1.0)
    judged = {"outlier": outlier, "outlier_lines": NO_ALARM, "misplaced": judging()}
    return Calibration(**{**dict(Calibration.neutral(relations)), **judged, **changes})


def places_of(V: int, triples: dict[tuple[int, int, int], float], **changes: np.ndarray) -> Places:
    """Places with these numbers of scenes. Every stand has the same share, and no role is known."""
    keys = sorted(((a * V + i) * V + j, scenes) for (a, i, j), scenes in triples.items())
    arrays = {
        "triple": np.array([key for key, _ in keys], np.int32),
        "triple_scenes": np.array([scenes for _, scenes in keys], np.float32),
        "frequency": np.linspace(0.05, 0.45, V, dtype=np.float32),
        "role_pair": np.zeros(0, np.int32),
        "role_counts": np.zeros((0, 3), np.float32),
        "role_anchor": np.zeros((V, 3), np.float32),
        "stands": np.full((V, 3), 1 / 3, np.float32),
        "within": np.zeros(V, np.float32),
    }
    return Places(**{**arrays, **changes})


# A lamp on a desk, a vase on a shelf, a bed above a rug, and a vase on a lamp in a single scene.
PLACES = places_of(
    9,
    {(2, 1, 2): 30, (2, 5, 6): 12, (2, 0, 7): 8, (2, 5, 1): 1, (0, 3, 2): 20},
    stands=np.float32([[0.9, 0.05, 0.05], [0.2, 0.2, 0.6], [0.9, 0.02, 0.08], [0.9, 0.01, 0.09],
                       [0.96, 0.02, 0.02], [0.1, 0.1, 0.8], [0.5, 0.4, 0.1], [0.9, 0.05, 0.05],
                       [0.98, 0.01, 0.01]]),
)  # fmt: skip


def artifact_of(
    machine: BoltzmannMachine, places: Places | None = None, **changes: object
) -> SceneModel:
    """An artifact with a neutral calibration, except for the changed fields."""
    spec = machine.spec
    vocabulary = Vocabulary(
        [ObjectClass(label, structure=label in STRUCTURE) for label in LABELS[: spec.V]],
        ROOMS[: spec.C],
    )
    fitted = calibration(spec.A, **changes)
    return SceneModel(weights_of(machine), vocabulary, fitted, places=places)


def larger_artifact(name: str, scale: float = 0.7, **changes: object) -> SceneModel:
    """An artifact with weights from N(0, scale²), but without object weights of structure."""
    machine = random_machine(LARGER[name], scale)
    structure = [k for k, label in enumerate(LABELS) if label in STRUCTURE]
    for weights, parameter in machine.named_parameters():
        if weights in ("W", "L"):
            parameter[structure] = 0
    machine.a[:, structure] = 0
    if machine.spec.coupled:
        machine.L[:, structure] = 0
        machine.Y[:, structure] = 0
    return artifact_of(machine, PLACES, **changes)


def random_machine(spec: MachineSpec, scale: float) -> BoltzmannMachine:
    """A machine with random weights and units."""
    generator = torch.Generator().manual_seed(3)
    machine = build(spec)
    if spec.T:
        units = spec.A * spec.V**2
        keys = torch.randperm(units, generator=generator)[: spec.T].sort().values
        triples = torch.stack([keys // spec.V**2, keys // spec.V % spec.V, keys % spec.V], 1)
        machine.set_triples(triples)
    random_weights(machine, generator, scale)
    return machine.eval()


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
    table = None
    if relations is not None or complete:
        complete_for = len(objects) if complete else None
        table = RelationTable.stated(relations or (), complete_for=complete_for)
    return Scene(objects, table, room, profile)
