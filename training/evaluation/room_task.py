"""Rooms: of which room type is a scene?

A request lists all classes of a scene, or 2 or 4 random classes. Structure and the room type are
not listed. The short lists are drawn three times. Only scenes with a room type take part. A scene
whose room type a model cannot name counts as wrong, with the lowest probability.

Metrics:

    top-1, top-3   share of lists whose room type ranks among the first k; expected over ties
    log-loss       mean of -log p of the room type; p is at least `LEAST`
    ECE            calibration error of the likeliest room type's probability, in ten bins of
                   equally many lists

In the metrics "profile named", the request names the data source of the scene. The metrics "real
rooms" are those of the sources of real rooms alone.
"""

from __future__ import annotations

from typing import Final

import numpy as np
import torch

from training.datasets.batches import SceneTensors
from training.evaluation.asking import ask_rows
from training.evaluation.metrics import Metric, Ratio, Scored
from training.evaluation.missing_tasks import SEEDS
from training.evaluation.parts import (
    REAL_SOURCES,
    Parts,
    Ranking,
    Size,
    draw_parts,
    exactly,
    real_sources,
)
from training.evaluation.setting import Outcome, RoomScore, Setting, Structure, with_room_type

LEAST: Final = 1e-4  # least probability of a room type in the log-loss

LISTS: Final[dict[str, tuple[Size, tuple[int, ...]]]] = {
    "all classes": (lambda classes, _: classes, SEEDS[:1]),
    "4 classes": (exactly(4), SEEDS),
    "2 classes": (exactly(2), SEEDS),
}
"""Lists of a scene by name: their number of classes, and the seeds of the draws."""

FIGURES: Final = ("top-1", "top-3", "log-loss", "ECE")


def room_figures(
    scenes: SceneTensors, parts: Parts, score: RoomScore, profile: str = ""
) -> dict[str, Metric]:
    """Return `FIGURES` for lists of scenes with a room type."""
    scene, target, count = parts.scene.numpy(), scenes.room[parts.scene], len(scenes)
    log_p = ask_rows(lambda v: score(v, profile), parts.v)
    # At least three other types rank before a type that the model cannot name.
    is_named = (target < log_p.shape[1]).unsqueeze(1)
    lowest, added = torch.finfo(log_p.dtype).min, int(target.max()) + 4
    log_p = torch.nn.functional.pad(log_p, (0, added), value=lowest)
    log_p = torch.where(is_named, log_p, log_p.scatter(1, target.unsqueeze(1), -torch.inf))
    ranking = Ranking.of(parts.scene, target, log_p, count)
    p, likeliest = log_p.exp().double().max(1)
    hit = (likeliest == target).numpy()
    loss = -log_p.gather(1, target.unsqueeze(1)).squeeze(1).clamp(min=float(np.log(LEAST)))
    return {
        "top-1": ranking.top(1),
        "top-3": ranking.top(3),
        "log-loss": Ratio.of_items(scene, loss.double().numpy(), count),
        "ECE": Scored("ECE", scene, p.numpy(), hit, np.arange(count)),
    }


def rooms_task(score: RoomScore, setting: Setting) -> Outcome | None:
    """Measure the likeliest room types, without and with the named profile."""
    scenes = with_room_type(setting.some())
    sources = {scene.source for scene in scenes.scenes}
    metrics: dict[str, Metric] = {}
    for name, (size, seeds) in LISTS.items():
        parts = draw_parts(scenes, setting.structure, size, seeds)
        if not len(parts.v):
            continue
        kinds = {name: ""} | ({f"{name}, profile named": min(sources)} if len(sources) == 1 else {})
        for kind, profile in kinds.items():
            figures = room_figures(scenes, parts, score, profile)
            metrics |= {f"{figure}, {kind}": metric for figure, metric in figures.items()}
    if sources <= set(REAL_SOURCES):
        metrics |= {f"{name}, real rooms": metric for name, metric in metrics.items()}
    return Outcome.over(scenes, metrics, 0)


def mean_log_p(scenes: SceneTensors, structure: Structure, score: RoomScore) -> float:
    """Return the mean over real sources and lists of log p of the room type.

    Each list counts without and with the named profile. If the scenes contain no source of
    `REAL_SOURCES`, all sources count.

    Raises:
        ValueError: no scene has a room type.
    """
    values = []
    for source, sample in real_sources(with_room_type(scenes)):
        for size, seeds in LISTS.values():
            parts = draw_parts(sample, structure, size, seeds)
            values += [
                -room_figures(sample, parts, score, profile)["log-loss"].value
                for profile in ("", source)
                if len(parts.v)
            ]
    if not values:
        raise ValueError("no scene has a room type")
    return float(np.mean(values))
