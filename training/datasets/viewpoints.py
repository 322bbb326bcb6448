"""A viewpoint for rooms whose axes mean nothing."""

from __future__ import annotations

import hashlib
import math

import numpy as np
from numpy.typing import NDArray

from app.scene import Viewpoint


def room_viewpoint(scene_id: str, positions: NDArray[np.float64]) -> Viewpoint:
    """Somebody who stands at the middle of one side of the room and looks straight in.

    The room is the bounding box of the object centres; a hash of the scene's id draws the side, so
    that a scene is always seen from the same place and a collection from all sides.

    Args:
        scene_id: the scene.
        positions: (n, 3) centres in metres; rows with NaN do not count.

    Raises:
        ValueError: no object has a position.
    """
    known = positions[np.isfinite(positions).all(axis=1), :2]
    if not len(known):
        raise ValueError(f"scene {scene_id!r} has no object with a position")
    (x0, y0), (x1, y1) = known.min(axis=0).tolist(), known.max(axis=0).tolist()
    x, y = (x0 + x1) / 2, (y0 + y1) / 2
    return (
        Viewpoint(x0, y, 0.0),
        Viewpoint(x, y0, math.pi / 2),
        Viewpoint(x1, y, math.pi),
        Viewpoint(x, y1, -math.pi / 2),
    )[hashlib.sha256(scene_id.encode()).digest()[0] % 4]
