"""Furnished rooms of the generator, and a model of them."""

from dataclasses import replace
from functools import cache

import torch

from app.model import Calibration, CountSlope, SceneModel
from app.scene import CANONICAL
from tests.questions.artifacts import lines
from training.datasets import annotated_classes, encode, generate_rooms, rooms_vocabulary
from training.datasets.batches import SceneTensors, scene_tensors
from training.fit.draft import draft_artifact
from training.machines import MachineSpec, build

A = len(CANONICAL)
VOCABULARY = rooms_vocabulary()
STRUCTURE = torch.from_numpy(VOCABULARY.structure.copy())


@cache
def rooms(count: int, seed: int) -> SceneTensors:
    scenes = encode(generate_rooms(count, seed), VOCABULARY)
    return scene_tensors(scenes, annotated_classes(scenes, VOCABULARY), VOCABULARY)


@cache
def room_model() -> SceneModel:
    """An untrained machine with random weights."""
    spec = MachineSpec("triway", V=len(VOCABULARY), A=A, units=6, K=3, C=len(VOCABULARY.room_types))
    machine = build(spec)
    generator = torch.Generator().manual_seed(5)
    with torch.no_grad():
        for parameter in machine.parameters():
            parameter.copy_(torch.randn(parameter.shape, generator=generator) * 0.5)
    calibration = Calibration.neutral(A).model_copy(
        update={"outlier": CountSlope(slope=-1.0), "outlier_lines": lines(0.0, 0.0, 0.0)}
    )
    draft = draft_artifact(machine.eval().requires_grad_(False), VOCABULARY)
    return replace(draft, calibration=calibration)
