"""Small machines, described well enough to be published, and ways to spoil what was written."""

import hashlib
import json
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from app.model import AlarmLine, AlarmLines, Calibration, CountSlope, Judgement, Misplaced
from app.model.calibration import KINDS, WEIGHTS
from app.registry import (
    AliasTarget,
    Artifact,
    ArtifactError,
    Description,
    Store,
    StoreError,
    VocabularyEntry,
)
from app.registry.__main__ import main
from app.registry.manifest import FORMAT, MANIFEST
from app.registry.references import Replacement, Shipped, aliases_to_bytes
from app.scene.vocabulary import ObjectClass, Vocabulary

VOCABULARY = Vocabulary(
    [
        ObjectClass("bed", ("cot",), size=(2.0, 1.5, 0.5)),
        ObjectClass("lamp", ("table lamp", "desk lamp")),
        ObjectClass("floor", structure=True),
    ],
    ("bedroom", "office"),
)

# One of each variant; a new one is put through the round trip by an entry here.
SPECS: dict[str, dict[str, Any]] = {
    "rbm": {"variant": "rbm", "V": 3, "A": 5, "units": 5, "C": 2, "T": 2},
    "gbm": {"variant": "gbm", "V": 3, "A": 5, "units": 5, "T": 2},
    "triway": {"variant": "triway", "V": 3, "A": 5, "units": 2, "states": 4, "C": 2, "K": 2, "T": 2}
    | {"profiles": 2, "coupled": True},
}
PROFILES = {"rbm": (), "gbm": (), "triway": ("homes", "shops")}

EVEN = AlarmLine(intercept=0.0)
HALF = AlarmLines(low=EVEN, medium=EVEN, high=EVEN)
WRONG = Judgement(intercept=0.0, lines=HALF, **dict.fromkeys(WEIGHTS, -1.0))
JUDGING = {
    "outlier": CountSlope(slope=-1.0),
    "outlier_lines": HALF,
    "misplaced": Misplaced(**dict.fromkeys(KINDS, WRONG)),
}

DATA = {
    "source": "generated",
    "scenes": 12,
    "digest": "0" * 64,
    "terms": "Apache-2.0",
    "research_only": False,
}
FIGURE = {"value": 0.5, "low": 0.4, "high": 0.6, "n": 34}


def description(
    name: str = "tiny", version: str = "1.0.0", variant: str = "rbm", **changes: Any
) -> Description:
    """What would be said of a machine of `SPECS`; `changes` replace fields."""
    return Description.model_validate(
        {
            "name": name,
            "version": version,
            "created": "2020-02-02T20:20:20+00:00",
            "spec": SPECS[variant],
            "vocabulary": VocabularyEntry.of(VOCABULARY, profiles=PROFILES[variant]),
            "calibration": Calibration.neutral(5).model_copy(update=JUDGING),
            "training": {"objects": {"steps": 800}, "seed": 7, "rate": 0.1},
            "data": [DATA],
            "metrics": [{"task": "missing", "source": "generated", "metric": "MRR", **FIGURE}],
            "terms": "Apache-2.0",
            "libraries": {"torch": "2.0"},
            **changes,
        }
    )


def state(variant: str = "rbm", seed: int = 0) -> dict[str, np.ndarray]:
    """Random weights of a machine of `SPECS`, as its `state_dict` would hold them."""
    from training.machines import MachineSpec, build

    generator = np.random.default_rng(seed)
    tensors = {}
    for name, tensor in build(MachineSpec.from_dict(SPECS[variant])).state_dict().items():
        drawn = generator.normal(size=tuple(tensor.shape)).astype(np.float32)
        tensors[name] = drawn if tensor.is_floating_point() else tensor.numpy().copy()
    tensors["triples"][:] = [(0, 0, 1), (2, 1, 0)]
    if "L" in tensors:
        tensors["L"] += tensors["L"].T
        np.fill_diagonal(tensors["L"], 0)
    return tensors


def resign(body: bytes) -> bytes:
    """A manifest with a true checksum; body is its JSON without one."""
    body = body.rstrip().removesuffix(b"}").rstrip()
    return body + b',\n"checksum": "' + hashlib.sha256(body).hexdigest().encode() + b'"\n}\n'


def rewrite_manifest(directory: Path, change: Callable[[dict[str, Any]], object]) -> None:
    """Change the manifest and give it a true checksum, as somebody with a purpose would."""
    members = json.loads((directory / MANIFEST).read_bytes())
    del members["checksum"]
    change(members)
    (directory / MANIFEST).write_bytes(resign(json.dumps(members).encode()))


def make_outdated(store: Store, name: str, version: str) -> None:
    folder = store.root / name / version
    rewrite_manifest(folder, lambda members: members.update(format=FORMAT - 1))


def state_replaced(
    release: Store, volume: Store, replaced: Mapping[str, str], versions: Sequence[str] = ()
) -> None:
    """Let a release state its default, and that it replaces the versions of a volume."""
    digests = {
        old: {v: str(volume.digest(old, v)) for v in versions or volume.versions(old)}
        for old in replaced
    }
    entries = {old: Replacement(by=new, digests=digests[old]) for old, new in replaced.items()}
    shipped = Shipped(default=release.aliases()["default"], replaced=entries)
    text = aliases_to_bytes(release.aliases(), shipped)
    (release.root / "aliases.json").write_bytes(text)


def copy(source: Store, target: Store, *references: str) -> int:
    """The exit status of the command that copies models."""
    return main(["copy", *references, "--from", str(source.root), "--to", str(target.root)])


def replace_file(directory: Path, name: str, data: bytes) -> None:
    """Exchange a file and let the manifest vouch for the new one."""
    (directory / name).write_bytes(data)
    entry = {"sha256": hashlib.sha256(data).hexdigest(), "bytes": len(data)}
    rewrite_manifest(directory, lambda members: members["files"].update({name: entry}))


def refused(code: str) -> pytest.RaisesExc[ArtifactError | StoreError]:
    return pytest.raises((ArtifactError, StoreError), check=lambda error: error.code == code)


def publish_as(
    store: Store, alias: str, described: Description, weights: Any, **options: Any
) -> Artifact:
    artifact = store.publish(described, weights, **options)
    name, version = artifact.key
    store.set_alias(alias, AliasTarget(name=name, version=version))
    return artifact
