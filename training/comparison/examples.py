"""The questions whose answers differ most between two models."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from app.scene import Vocabulary
from training.batches import SceneTensors
from training.comparison.translation import BEYOND
from training.evaluation.missing import ObjectScore, leave_one_out

# Answers that are shown of each model.
_FIRST = 3


@dataclass(frozen=True)
class Example:
    """One object taken out of one scene.

    Attributes:
        scene: its id; room_type: or "".
        shown: labels that were left.
        removed: the label that was taken out.
        ranks: of the removed one, by either model; the first of them where it is one of a tie.
        answers: the first few of either.
    """

    scene: str
    room_type: str
    shown: tuple[str, ...]
    removed: str
    ranks: tuple[int, int]
    answers: tuple[tuple[str, ...], tuple[str, ...]]


def changed_most(
    a: ObjectScore,
    b: ObjectScore,
    scenes: SceneTensors,
    structure: Tensor,
    vocabulary: Vocabulary,
    count: int,
) -> list[Example]:
    """The removed objects whose reciprocal rank differs most, one a group, the largest first."""
    first, second = (leave_one_out(scenes, structure, score) for score in (a, b))
    change = np.abs(first.reciprocal_rank() - second.reciprocal_rank())
    chosen: dict[str, int] = {}
    for place in np.argsort(-change, kind="stable").tolist():
        if len(chosen) == count or not change[place]:
            break
        chosen.setdefault(scenes.scenes[int(first.scene[place])].group, place)
    found = []
    for place in chosen.values():
        scene = int(first.scene[place])
        target = int(first.target[place])
        found.append(
            Example(
                scene=scenes.scenes[scene].scene_id,
                room_type=_room(vocabulary, scenes.scenes[scene].room_type),
                shown=_shown(scenes, scene, target, vocabulary),
                removed=vocabulary.labels[target],
                ranks=(int(first.above[place]) + 1, int(second.above[place]) + 1),
                answers=(
                    _answers(a, scenes, scene, target, structure, vocabulary),
                    _answers(b, scenes, scene, target, structure, vocabulary),
                ),
            )
        )
    return found


def _room(vocabulary: Vocabulary, index: int) -> str:
    return vocabulary.room_types[index] if index >= 0 else ""


def _shown(
    scenes: SceneTensors, scene: int, target: int, vocabulary: Vocabulary
) -> tuple[str, ...]:
    present = scenes.v[scene].nonzero().squeeze(1).tolist()
    return tuple(vocabulary.labels[index] for index in present if index != target)


def _answers(
    score: ObjectScore,
    scenes: SceneTensors,
    scene: int,
    target: int,
    structure: Tensor,
    vocabulary: Vocabulary,
) -> tuple[str, ...]:
    """The likeliest missing objects, as they are asked for in the task."""
    v = scenes.v[scene].clone()
    v[target] = 0.0
    with torch.no_grad():
        values = score(v.unsqueeze(0))[0].masked_fill((v > 0) | structure, -torch.inf)
    order = values.argsort(descending=True, stable=True)[:_FIRST].tolist()
    # What a model has no class for is no answer of it.
    return tuple(vocabulary.labels[index] for index in order if values[index] > -BEYOND)
