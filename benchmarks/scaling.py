"""Benchmark of larger vocabularies: memory of the loaded model, and latency of every question.

The models have random weights. Their sizes, their standard deviations and the number of objects per
scene are those of the shipped default model. Latency depends on these properties, not on the learnt
values. One exception: random relation weights have a higher rank than trained weights, so
`/relations` takes longer here than in the service. The benchmark therefore only compares vocabulary
sizes.
"""

from __future__ import annotations

import gc
import multiprocessing
import os
from collections.abc import Callable, Mapping, Sequence
from datetime import UTC, datetime
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory

import torch

from app import questions
from app.inference.weights import pack_scenes
from app.model import SceneModel
from app.model.calibration import Calibration
from app.registry.artifact import load_artifact, write_artifact
from app.registry.description import Description, VocabularyEntry
from app.scene.scene import Scene, SceneObject
from app.scene.spatial_relations import CANONICAL
from app.scene.vocabulary import ObjectClass, Vocabulary
from benchmarks.report import Fact, Result
from benchmarks.timing import interleave
from benchmarks.yardsticks import object_machine, presence, random_scenes
from training.machines import BoltzmannMachine, MachineSpec, Triway

CLASSES = (417, 2_000, 10_000)
OBJECTS, SCENES = 12, 8

# Standard deviations of the relation weights in the default model, by parameter name.
# `object_machine` draws the other weights. Couplings stay 0: their time does not depend on values.
_SPREAD = {"S": 0.065, "O": 0.065, "R": 0.32, "M": 0.23, "P": 0.06, "B": 0.14}
_TRIPLES_A_CLASS = 17
_MEGABYTE = 1e6


def scaling(
    *,
    classes: Sequence[int] = CLASSES,
    units: int = 8,
    states: int = 32,
    K: int = 32,
    N: int = 512,
    objects: int = OBJECTS,
    rounds: int = 31,
) -> list[Result]:
    """Time every question for several vocabulary sizes, and return one result per question.

    Args:
        classes: vocabulary sizes in increasing order. The first size is the reference.
        units, states, K, N: sizes of the machine; see `MachineSpec`.
        objects: number of objects in the scene, equal for all sizes.
        rounds: number of rounds; each round times every size.
    """
    drawn = random_scenes(1, classes[0], objects, torch.Generator().manual_seed(1))[0].tolist()
    scene = Scene(tuple(SceneObject(_label(i), _label(i), i) for i in drawn))
    sizes = {"units": units, "states": states, "K": K, "N": N}
    sizes |= {"A": len(CANONICAL), "C": 33, "G": 8}
    with TemporaryDirectory() as folder:
        paths = {
            V: _write(
                Path(folder) / str(V),
                MachineSpec("triway", V=V, T=_TRIPLES_A_CLASS * V, coupled=True, **sizes),
                objects,
            )
            for V in classes
        }
        memory = {V: _memory(paths[classes[0]], paths[V], scene) for V in classes}
        files = {V: sum(file.stat().st_size for file in paths[V].iterdir()) for V in classes}
        models = {V: load_artifact(path).model for V, path in paths.items()}
    names = {V: f"{V:,} classes" for V in classes}
    facts: dict[str, Fact] = {}
    for V, name in names.items():
        facts[f"{name}, artifact in MB"] = files[V] / _MEGABYTE
        facts[f"{name}, loaded and asked everything, resident MB"] = memory[V] / _MEGABYTE
        facts[f"{name}, resident kB a class"] = memory[V] / V / 1e3
    results: list[Result] = []
    for question, ask in QUESTIONS.items():
        calls = {names[V]: partial(ask, model, scene) for V, model in models.items()}
        results.append(
            Result(
                title=f"/{question}: latency relative to {names[classes[0]]}",
                subject=names[classes[0]],
                timings=interleave(calls, rounds=rounds),
                facts={} if results else facts,
            )
        )
    return results


QUESTIONS: Mapping[str, Callable[[SceneModel, Scene], object]] = {
    "relations": questions.relations,
    "missing": questions.missing,
    "outliers": questions.outliers,
    "rooms": questions.rooms,
    f"generate of {SCENES}": partial(questions.generate, count=SCENES, seed=1),
}


def _label(number: int) -> str:
    return f"class {number}"


def _write(path: Path, spec: MachineSpec, objects: int) -> Path:
    machine = _machine(spec, objects)
    vocabulary = Vocabulary(
        [ObjectClass(_label(number)) for number in range(spec.V)],
        [f"room {number}" for number in range(spec.C)],
    )
    description = Description(
        name="random",
        version="0.0.1",
        created=datetime.now(UTC),
        spec=spec.to_dict(),
        vocabulary=VocabularyEntry.of(vocabulary),
        calibration=Calibration.neutral(spec.A),
        training={"objective": "none: random weights"},
        data=(),
        metrics=(),
        terms="none",
        libraries={},
    )
    write_artifact(path, description, machine.state_dict())
    return path


@torch.no_grad()
def _machine(spec: MachineSpec, objects: int) -> BoltzmannMachine:
    machine = object_machine(spec, objects)
    generator = torch.Generator().manual_seed(2)
    if not isinstance(machine, Triway):
        raise TypeError("the scaling benchmark needs a Triway machine")
    for name, spread in _SPREAD.items():
        parameter = machine.get_parameter(name)
        parameter.copy_(torch.randn(parameter.shape, generator=generator) * spread)
    machine.d.fill_(-2.0)
    # gamma lets observed relations change other relations. Random weights of full size would turn
    # on hundreds of relations.
    machine.get_parameter("gamma").mul_(0.2)
    # Distinct sorted triples (relation, subject, object), evenly spread over all possible triples.
    units = spec.A * spec.V**2
    keys = (torch.arange(spec.T, dtype=torch.float64) * (units / spec.T)).long()
    square = spec.V**2
    machine.set_triples(torch.stack([keys // square, keys // spec.V % spec.V, keys % spec.V], 1))
    if spec.N:
        samples = presence(random_scenes(spec.N, spec.V, objects, generator), spec.V)
        machine.fantasies.copy_(torch.from_numpy(pack_scenes(samples.numpy())))
        machine.fantasy_rooms.copy_(torch.arange(spec.N) % spec.C)
    return machine


def _memory(first: Path, path: Path, scene: Scene) -> int:
    """Return the resident memory in bytes that a new process needs to load and query a model."""
    # The process first queries another model, so that the compiled kernels are already loaded.
    with multiprocessing.get_context("spawn").Pool(1) as pool:
        return pool.apply(_resident, (first, path, scene))


def _resident(first: Path, path: Path, scene: Scene) -> int:
    torch.set_num_threads(1)
    kept = [_asked(first, scene)]
    before = _resident_bytes()
    kept.append(_asked(path, scene))
    return _resident_bytes() - before


def _asked(path: Path, scene: Scene) -> SceneModel:
    model = load_artifact(path).model
    for ask in QUESTIONS.values():
        ask(model, scene)
    return model


def _resident_bytes() -> int:
    gc.collect()
    pages = int(Path("/proc/self/statm").read_text(encoding="ascii").split()[1])
    return pages * os.sysconf("SC_PAGE_SIZE")
