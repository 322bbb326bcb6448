"""Model stores for tests: real artifacts of small machines with random weights."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch

from app.model import Calibration
from app.model.fields import TensorGroup
from app.registry import AliasTarget, Store, VocabularyEntry
from app.scene.spatial_relations import CANONICAL
from app.scene.vocabulary import ObjectClass, Vocabulary
from tests.enumeration.small_machines import random_weights
from tests.registry.small_artifacts import JUDGING, description
from training.machines import BoltzmannMachine, MachineSpec, build

VOCABULARY = Vocabulary(
    [
        ObjectClass("bed"),
        ObjectClass("nightstand", ("bedside table",)),
        ObjectClass("lamp", size=(0.2, 0.2, 0.4)),
        ObjectClass("chair"),
        ObjectClass("table", ("desk table",)),
        ObjectClass("desk", size=(0.7, 1.4, 0.8), parent="table"),
        ObjectClass("television", ("tv",)),
        ObjectClass("keyboard"),
        ObjectClass("garbage bin", ("trash can", "waste basket")),
        ObjectClass("sofa", ("couch",)),
        ObjectClass("sink"),
        ObjectClass("toilet"),
        ObjectClass("book", anywhere=True),
        ObjectClass("pillow"),
        ObjectClass("floor", structure=True),
        ObjectClass("object", structure=True),
    ],
    ("bedroom", "bathroom", "office"),
    {"bathroom": ("toilet",), "office": ("study",)},
)
V, A, C = len(VOCABULARY), len(CANONICAL), len(VOCABULARY.room_types)
TRIPLES = torch.tensor([(0, 0, 1), (0, 1, 0), (1, 3, 5), (2, 2, 1), (2, 7, 5), (3, 2, 0)])
SPECS = {
    "triway": MachineSpec(
        "triway", V=V, A=A, units=4, states=4, C=C, K=3, profiles=2, coupled=True
    ),
    "gbm": MachineSpec("gbm", V=V, A=A, units=6, C=C),
    "rbm": MachineSpec("rbm", V=V, A=A, units=6, C=C),
}
PROFILES = ("homes", "shops")


def random_machine(
    variant: str, seed: int = 0, classes: int = V, room_types: int = C
) -> BoltzmannMachine:
    """A machine for the first ``classes`` classes, with all weights drawn from N(0, 0.5²)."""
    triples = TRIPLES[(TRIPLES[:, 1:] < classes).all(dim=1)]
    spec = replace(SPECS[variant], V=classes, C=room_types, T=len(triples))
    machine = build(spec).set_triples(triples)
    return random_weights(machine, torch.Generator().manual_seed(seed), 0.5)


LAMP = {"label": "lamp", "position": {"x": 1, "y": 0.5, "z": 1}}
EXAMPLES = [{"name": "A bedroom", "scene": {"room_type": "bedroom", "objects": ["bed", LAMP]}}]


def publish(
    root: Path,
    name: str,
    version: str,
    *,
    variant: str = "triway",
    seed: int = 0,
    classes: int = V,
    room_types: int = C,
    alias: str | None = None,
    groups: Sequence[TensorGroup] = (),
    calibration: Mapping[str, Any] = JUDGING,
) -> None:
    """Publish a machine with random weights for the first classes and room types.

    `calibration` has the fields that are not neutral. Without `JUDGING`, the model judges nothing.
    """
    machine = random_machine(variant, seed, classes, room_types)
    names = VOCABULARY.room_types[:room_types]
    aliases = {name: VOCABULARY.room_aliases.get(name, ()) for name in names}
    vocabulary = Vocabulary(VOCABULARY.objects[:classes], names, aliases)
    Store(root).publish(
        description(
            name,
            version,
            spec=machine.spec.to_dict(),
            vocabulary=VocabularyEntry.of(vocabulary, profiles=PROFILES[: machine.spec.profiles]),
            calibration=Calibration.neutral(A).model_copy(update=calibration),
            examples=EXAMPLES if classes == V else (),
        ),
        machine.state_dict() | {k: t for group in groups for k, t in group.tensors().items()},
    )
    if alias is not None:
        Store(root).set_alias(alias, AliasTarget(name=name, version=version))


def make_store(root: Path) -> Path:
    """Make a store with home 1.0.0 (default), home 1.1.0 (candidate), an RBM and a GBM."""
    publish(root, "home", "1.0.0", alias="default")
    publish(root, "home", "1.1.0", seed=1, alias="candidate")
    publish(root, "plain", "1.0.0", variant="rbm")
    publish(root, "general", "0.1.0", variant="gbm")
    return root


def corrupt(root: Path, name: str, version: str) -> None:
    """Change one byte of a version's weights file."""
    weights = root / name / version / "model.safetensors"
    data = bytearray(weights.read_bytes())
    data[-1] ^= 0x40
    weights.chmod(0o644)
    weights.write_bytes(bytes(data))
