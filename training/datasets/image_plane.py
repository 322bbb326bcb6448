"""Relations between the boxes of an image, left and above: `scene_client.image_plane`."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from app.scene import CANONICAL, PoseRelations, canonicalise
from scene_client.image_plane import are_neighbours, relation_between

_IN_THE_IMAGE = [CANONICAL.index("left"), CANONICAL.index("above")]


def derive_from_boxes(boxes: ArrayLike) -> PoseRelations:
    """Relations of n boxes.

    Args:
        boxes: (n, 4) rows (xmin, ymin, xmax, ymax), y downwards; a row with NaN is unseen.

    Raises:
        ValueError: a wrong shape.
    """
    corners = np.asarray(boxes, dtype=np.float64)
    n = len(corners)
    if corners.shape != (n, 4) and n:
        raise ValueError(f"boxes has shape {corners.shape}, must be {(n, 4)}")
    rows = [tuple(row) for row in corners.tolist()]
    holds = np.zeros((len(CANONICAL), n, n), dtype=np.bool_)
    observed = np.zeros_like(holds)
    for i in range(n):
        for j in range(i + 1, n):
            if not are_neighbours(rows[i], rows[j]):
                continue
            observed[_IN_THE_IMAGE, i, j] = observed[_IN_THE_IMAGE, j, i] = True
            if (relation := relation_between(rows[i], rows[j])) is not None:
                holds[canonicalise(i, relation, j)] = True
    return PoseRelations(holds, observed)
