"""Task T4 rooms: the filter of `/generate`, and the sizes of generated rooms.

    refused        share of held-out rooms that do not reach the limits of a generated scene of
                   their room type (`app.questions.generate.is_within_limits`)
    change of the number of classes
                   mean number of classes of generated scenes, divided by that of held-out whole
                   rooms, minus 1. The scenes are drawn as the service draws them, without evidence
                   ("free"), or with a room type

The metrics cover common room types of homes and offices. Structure, such as walls, does not count.
Only sources of whole rooms (`training.datasets.sources`) have sizes: lists of camera frames are
parts of rooms. For intervals, the held-out scenes are resampled and the generated scenes are fixed.
"""

from __future__ import annotations

from typing import Final

import numpy as np
from torch import Tensor

from app.inference.chains import Conditions, random_stream
from app.model import SceneModel
from app.questions.generate import STEPS, draw_plausible, is_within_limits
from app.scene import Scene
from training.datasets.array_types import Floats, Ints
from training.datasets.sources import source_of
from training.evaluation.metrics import Metric, Ratio, Resampled
from training.evaluation.setting import Outcome, Setting

ROOMS: Final = ("bedroom", "kitchen", "bathroom", "living room", "office")
FREE: Final = "free"
REFUSED: Final = "refused"
SIZE: Final = "change of the number of classes"

_FEWEST = 10  # held-out scenes of a room type
_DRAWS = 200  # generated scenes of each condition
_RESAMPLES = 200


def generated_rooms_task(artifact: SceneModel, setting: Setting) -> Outcome | None:
    """Measure the task on held-out scenes. The figures of a room type need 10 scenes."""
    names = artifact.vocabulary.room_types
    types = {name: names.index(name) for name in ROOMS if artifact.spec.C and name in names}
    scenes, things = setting.some(), ~setting.structure
    room, present = scenes.room.numpy(), (scenes.v > 0) & things
    metrics: dict[str, Metric] = {}
    asked = np.isin(room, list(types.values())) & present.any(1).numpy()
    refused = np.zeros(len(scenes))
    for k in np.flatnonzero(asked):
        classes = present[k].nonzero().squeeze(1).tolist()
        refused[k] = not is_within_limits(artifact, classes, int(room[k]))
    of_type = {name: asked & (room == t) for name, t in types.items()}
    for name, mask in (("", asked), *of_type.items()):
        if mask.sum() >= _FEWEST:
            metrics[f"{REFUSED}, {name}" if name else REFUSED] = Ratio.of_scenes(
                refused * mask, mask
            )
    whole = np.array([source_of(scene.source).whole_rooms for scene in scenes.scenes], np.bool_)
    sizes = present.sum(1).double().numpy()
    for name, mask in {FREE: whole, **{n: m & whole for n, m in of_type.items()}}.items():
        if mask.sum() >= _FEWEST:
            drawn = _drawn_size(artifact, types.get(name), things, setting.seed)
            change = _change(drawn, sizes[mask], scenes.group_ids[mask])
            metrics[f"{SIZE}, {name}"] = change
    return Outcome.over(scenes, metrics, int((~asked).sum()))


def _drawn_size(artifact: SceneModel, room: int | None, things: Tensor, seed: int) -> float:
    """Return the mean number of classes of generated scenes, without structure."""
    chains = artifact.scene_chains.under(Conditions(np.zeros(0, np.int64), None, room))
    evidence, is_thing = Scene((), room_type=room), things.numpy()
    sizes = [
        int(is_thing[draw_plausible(artifact, chains, evidence, STEPS, stream).classes].sum())
        for stream in (random_stream(seed, k) for k in range(_DRAWS))
    ]
    return float(np.mean(sizes))


def _change(drawn: float, sizes: Floats, groups: Ints) -> Metric:
    """Return the relative change of a mean size against held-out sizes, (scenes,)."""

    def change(weight: Floats) -> float:
        return float(drawn * weight.sum() / (weight @ sizes) - 1)

    return Resampled.of(change, groups, _DRAWS, _RESAMPLES)
