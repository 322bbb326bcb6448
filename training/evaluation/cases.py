"""Random choices of an evaluation, scene by scene.

What is drawn for a scene depends on the seed and on the scene's name alone: not on the model, on
the other scenes, or on how they are batched. So every model is asked the same questions, one source
at a time or all together.
"""

from __future__ import annotations

from zlib import crc32

import numpy as np
import torch

from training.batches import SceneTensors
from training.datasets import EncodedScene
from training.trainer import subset


def scene_rng(scene: EncodedScene, seed: int) -> np.random.Generator:
    """The random numbers of one scene."""
    return np.random.default_rng([seed, crc32(scene.scene_id.encode())])


def some_scenes(scenes: SceneTensors, limit: int | None, seed: int = 0) -> SceneTensors:
    """At most `limit` scenes, the same ones for everybody, in their order."""
    if limit is None or len(scenes) <= limit:
        return scenes
    place = [crc32(f"{seed} {scene.source} {scene.scene_id}".encode()) for scene in scenes.scenes]
    return subset(scenes, torch.from_numpy(np.sort(np.argsort(place, kind="stable")[:limit])))
