"""Relations between boxes in an image: left and above, as the camera sees them.

Without depth there is no front, and no telling what rests on what; *above* in the image may be
farther away on the floor. Offsets count in units of the boxes, as an image has no metres: boxes
are neighbours if the gap between them is at most the mean of their diagonals, the larger offset
between the centres decides, and offsets under 10 % of that mean decide nothing.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from app.scene import CANONICAL, PoseRelations

_LEFT, _ABOVE = CANONICAL.index("left"), CANONICAL.index("above")
_MIN_OFFSET = 0.10


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
    corners = corners.reshape(n, 4)
    low, high = corners[:, :2], corners[:, 2:]
    diagonal = np.hypot(*(high - low).T)
    unit = (diagonal[:, None] + diagonal[None]) / 2
    offset = (low + high)[:, None] / 2 - (low + high)[None] / 2
    apart = np.maximum(low[:, None] - high[None], low[None] - high[:, None]).clip(min=0)
    # Comparisons with NaN are false: what is unseen has no neighbours.
    neighbours = (np.hypot(apart[..., 0], apart[..., 1]) <= unit) & ~np.eye(n, dtype=np.bool_)
    du, dv = offset[..., 0], offset[..., 1]
    sideways = np.abs(du) >= np.abs(dv)
    far = np.maximum(np.abs(du), np.abs(dv)) >= _MIN_OFFSET * unit
    holds = np.zeros((len(CANONICAL), n, n), dtype=np.bool_)
    observed = np.zeros_like(holds)
    holds[_LEFT] = neighbours & far & sideways & (du < 0)
    holds[_ABOVE] = neighbours & far & ~sideways & (dv < 0)
    observed[[_LEFT, _ABOVE]] = neighbours
    return PoseRelations(holds, observed)
