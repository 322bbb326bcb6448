"""Small scenes with a known structure, for fitting baselines in a moment."""

from functools import partial

import numpy as np
import torch

from tests.training.evaluation import scenes as evaluation
from tests.training.evaluation.scenes import toy as scene
from training.datasets.batches import SceneTensors

# 0-3 belong to the kitchen, 4-7 to the bedroom, 8 is anywhere, 9 is structure, 10 never occurs.
KITCHEN, BEDROOM, ANYWHERE, FLOOR, V = (0, 1, 2, 3), (4, 5, 6, 7), 8, 9, 11
STRUCTURE = torch.arange(V) == FLOOR
LEFT, ON_TOP, A = 0, 1, 2
tensors = partial(evaluation.tensors, classes=V)


def furnished(count: int, seed: int) -> SceneTensors:
    """Kitchens and bedrooms, each class of the room there with probability .7. The room types are 0
    and 1. In both, the first class is on top of the second and left of the third, and the third is
    left of the fourth (so, by transitivity, the first is too)."""
    rng = np.random.default_rng(seed)
    scenes = []
    while len(scenes) < count:
        room = KITCHEN if rng.random() < 0.5 else BEDROOM
        classes = [c for c in room if rng.random() < 0.7]
        classes += [ANYWHERE] * bool(rng.random() < 0.5) + [FLOOR]
        first, second, third, fourth = room
        triples = [
            (ON_TOP, first, second),
            (LEFT, first, third),
            (LEFT, third, fourth),
            (LEFT, first, fourth),
        ]
        present = [t for t in triples if t[1] in classes and t[2] in classes]
        name = f"{seed}-{len(scenes)}"
        index = (KITCHEN, BEDROOM).index(room)
        scenes.append(scene(classes, present, name=name, group=name, room=index))
    return tensors(scenes)
