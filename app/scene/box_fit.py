"""Likelihood of the boxes of a scene under several readings of their numbers.

A reading has other axes, another size, another unit or another origin of each box. The likelihood
has three parts. Sizes follow those of their classes. Boxes stand on a common floor or on other
boxes, as usual for their classes. Boxes do not reach into each other.

    log p = Σ_i log t(d_i) + max_f Σ_i log p(b_i | f) + R · (number of pairs that overlap)

d_i has the log ratios of the footprint and of the height of box i to those of its class, divided by
the standard deviation of the class. t is Student's distribution. b_i is the height of the bottom of
box i, and f that of the floor.
"""

from __future__ import annotations

import math
from typing import Final, NamedTuple

import numpy as np
from jaxtyping import Float, Int
from numpy.typing import NDArray

from app.compiling import compiled

_DEGREES: Final = 4.0  # degrees of freedom of Student's distribution
_ASPECT: Final = 0.5  # log standard deviation of the ratio of the sides of a footprint
_THIN: Final = 0.02  # sides in m below which the deviation does not count
_CONTACT: Final = 0.04  # standard deviation of the gap between a bottom and its support in m
_STANDS: Final = 0.6  # share of the objects of a stand that show it, within the errors of boxes
_FREE: Final = 0.4  # density of other bottoms above the floor, per m
_HIGH: Final = 3.0  # height in m of half of this density
_SUNK: Final = 0.01  # density of bottoms below the floor, per m
_ANYWHERE: Final = 0.03  # share of bottoms at any height
_OVERLAP: Final = 0.05  # share of the smaller box above which two boxes overlap
_REACHES: Final = -1.0  # log odds R of an overlap
_UPRIGHT: Final = 0.95  # minimum vertical component of the upper axis of an upright box
_LOG_UPRIGHT: Final = math.log(0.91)
_LOG_TILTED: Final = math.log(0.08)
_LOG_OVERTURNED: Final = math.log(0.01)


class Boxes(NamedTuple):
    """n boxes in body axes and metres, and what is usual for their classes."""

    centre: Float[NDArray[np.float64], "n 3"]  # NaN where unknown
    size: Float[NDArray[np.float64], "n 3"]
    yaw: Float[NDArray[np.float64], "n"]
    turn: Float[NDArray[np.float64], "n 4"]  # quaternion of the request in xyzw, NaN without one
    typical: Float[NDArray[np.float64], "n 3"]  # size of the class
    spread: Float[NDArray[np.float64], "n"]  # log standard deviation of the sizes of the class
    stands: Float[NDArray[np.float64], "n 3"]  # shares: on the floor, hanging, supported


class Readings(NamedTuple):
    """R readings of boxes. The first one is the reading in which the boxes are given.

    Attributes:
        axis: the body axes that are ahead, left and up in the reading.
        sign: the signs of these axes.
        side: the sides of a box along these axes.
        size: factor of the sizes.
        place: factor of the positions, at most 1. A smaller one needs heights of more than 3 m.
        scale: factor of all lengths. NaN means the factor that fits the sizes best.
        shift: the way from the origin of an unrotated box to its centre, in halves of its sides.
        up: the axis of the frame that points up: 0 for z, 1 for y, 2 for -y.
    """

    axis: Int[NDArray[np.int64], "R 3"]
    sign: Float[NDArray[np.float64], "R 3"]
    side: Int[NDArray[np.int64], "R 3"]
    size: Float[NDArray[np.float64], "R"]
    place: Float[NDArray[np.float64], "R"]
    scale: Float[NDArray[np.float64], "R"]
    shift: Float[NDArray[np.float64], "R 3"]
    up: Int[NDArray[np.int64], "R"]


@compiled
def log_likelihoods(boxes: Boxes, readings: Readings) -> tuple[Float[NDArray, " R"], float]:
    """Return the log-likelihood of each reading, and the factor for a scale of NaN."""
    R, n = len(readings.size), len(boxes.yaw)
    result = np.empty(R)
    centre, size = np.empty((n, 3)), np.empty((n, 3))
    cos, sin = np.empty(n), np.empty(n)
    factor, is_tall = _common_factor(boxes), _height(boxes.centre) > _HIGH
    log_typical = np.empty((n, 3))
    for i in range(n):
        for k in range(3):
            log_typical[i, k] = math.log(max(boxes.typical[i, k], _THIN))
    places = sizes = 0.0
    for r in range(R):
        scale = factor if math.isnan(readings.scale[r]) else readings.scale[r]
        place = readings.place[r]
        if place < 1.0 and not is_tall:
            result[r] = -np.inf  # a room is no smaller than its boxes
            continue
        fit_of_sizes, fit_of_places = sizes, places
        if r == 0 or scale == 1.0:
            _read(boxes, readings, r, centre, size, cos, sin)
            # A factor of all lengths leaves the places of boxes to each other as they are.
            fit_of_places = fit_of_bottoms(centre, size, cos, sin, boxes.stands)
            fit_of_places += math.log(place) * _number(centre)  # density of the given heights
            fit_of_places += _REACHES * _overlaps(centre, size, cos, sin)
            if r == 0 or _has_other_sizes(readings, r):
                fit_of_sizes = _fit_of_sizes(size, log_typical, boxes.spread, 0.0)
        else:
            fit_of_sizes = _fit_of_sizes(boxes.size, log_typical, boxes.spread, math.log(scale))
        if r == 0:
            places, sizes = fit_of_places, fit_of_sizes
        result[r] = fit_of_sizes + fit_of_places + _fit_of_turns(boxes.turn, readings.up[r])
    return result, factor


@compiled
def _has_other_sizes(readings: Readings, r: int) -> bool:
    """Return whether the sizes of a reading differ from those of the first one."""
    same = readings.side[r, 0] == 0 and readings.side[r, 1] == 1
    return not same or readings.size[r] != 1.0


@compiled
def _height(centre: Float[NDArray, "n 3"]) -> float:
    """Return the difference in height of the highest and the lowest centre."""
    low, high = np.inf, -np.inf
    for i in range(len(centre)):
        low, high = min(low, centre[i, 2]), max(high, centre[i, 2])
    return high - low


@compiled
def _common_factor(boxes: Boxes) -> float:
    """Return the factor that makes sizes typical: the median of the boxes."""
    n = len(boxes.yaw)
    ratio = np.empty(n)
    for i in range(n):
        ratio[i] = 0.0
        for k in range(3):
            typical = max(boxes.typical[i, k], _THIN)
            ratio[i] += math.log(typical / max(boxes.size[i, k], _THIN)) / 3
    return math.exp(np.median(ratio))


@compiled
def _read(
    boxes: Boxes,
    readings: Readings,
    r: int,
    centre: Float[NDArray, "n 3"],
    size: Float[NDArray, "n 3"],
    cos: Float[NDArray, " n"],
    sin: Float[NDArray, " n"],
) -> None:
    """Write the boxes of reading r, with cosine and sine of the yaw, to the last arguments."""
    is_same = True
    for k in range(3):
        is_same &= readings.axis[r, k] == k and readings.side[r, k] == k
    side, origin = np.empty(3), np.empty(3)
    for i in range(len(cos)):
        c, s = math.cos(boxes.yaw[i]), math.sin(boxes.yaw[i])
        for k in range(3):
            side[k] = boxes.size[i, k]
        dx, dy = readings.shift[0, 0] * side[0] / 2, readings.shift[0, 1] * side[1] / 2
        origin[0] = boxes.centre[i, 0] - (c * dx - s * dy)
        origin[1] = boxes.centre[i, 1] - (s * dx + c * dy)
        origin[2] = boxes.centre[i, 2] - readings.shift[0, 2] * side[2] / 2
        if not (is_same or math.isnan(boxes.turn[i, 0])):
            # A yaw is about the upper axis of each reading, a quaternion about a fixed axis. So the
            # sides are those nearest to the axes of the frame.
            if abs(s) > abs(c):
                side[0], side[1] = side[1], side[0]
            c, s = 1.0, 0.0
        for k in range(3):
            centre[i, k] = origin[readings.axis[r, k]] * readings.sign[r, k] * readings.place[r]
            size[i, k] = side[readings.side[r, k]] * readings.size[r]
        dx, dy = readings.shift[r, 0] * size[i, 0] / 2, readings.shift[r, 1] * size[i, 1] / 2
        centre[i, 0] += c * dx - s * dy
        centre[i, 1] += s * dx + c * dy
        centre[i, 2] += readings.shift[r, 2] * size[i, 2] / 2
        cos[i], sin[i] = c, s


@compiled
def _fit_of_sizes(
    size: Float[NDArray, "n 3"],
    log_typical: Float[NDArray, "n 3"],
    spread: Float[NDArray, " n"],
    log_scale: float,
) -> float:
    """Return the log-likelihood of sizes times a factor, up to a constant."""
    total = 0.0
    for i in range(len(size)):
        x = _log_side(size[i, 0], log_scale)
        y = _log_side(size[i, 1], log_scale)
        z = _log_side(size[i, 2], log_scale)
        flat = (x + y - log_typical[i, 0] - log_typical[i, 1]) / 2
        high = z - log_typical[i, 2]
        aspect = (abs(x - y) - abs(log_typical[i, 0] - log_typical[i, 1])) / 2
        square = (flat * flat + high * high) / spread[i] ** 2 + (aspect / _ASPECT) ** 2
        total -= (_DEGREES + 3) / 2 * math.log(1.0 + square / _DEGREES)
    return total


@compiled
def _log_side(side: float, log_scale: float) -> float:
    return max(math.log(max(side, 1e-9)) + log_scale, math.log(_THIN))


@compiled
def fit_of_bottoms(
    centre: Float[NDArray, "n 3"],
    size: Float[NDArray, "n 3"],
    cos: Float[NDArray, " n"],
    sin: Float[NDArray, " n"],
    stands: Float[NDArray, "n 3"],
) -> float:
    """Return the log-likelihood of the bottoms of boxes with the likeliest floor.

    The floor is at the bottom of a box that usually stands on it. Without such a box, it is 0.
    """
    n, best = len(cos), -np.inf
    touch = _contacts(centre, size, cos, sin)
    for k in range(n):
        floor = centre[k, 2] - size[k, 2] / 2
        if math.isnan(floor) or stands[k, 0] < 0.5:
            continue
        total = 0.0
        for i in range(n):
            gap = centre[i, 2] - size[i, 2] / 2 - floor
            if math.isnan(gap):
                continue
            free = _FREE / (1.0 + (gap / _HIGH) ** 2) if gap > -1.5 * _CONTACT else _SUNK
            on_floor = _STANDS / _CONTACT * _near(gap)
            carried = _STANDS * _STANDS / _CONTACT * touch[i] + (1 - _STANDS) * free
            p = stands[i, 0] * on_floor + stands[i, 1] * free + stands[i, 2] * carried
            total += math.log((1.0 - _ANYWHERE) * p + _ANYWHERE * 0.1)
        best = max(best, total)
    return best if best > -np.inf else 0.0


@compiled
def _number(centre: Float[NDArray, "n 3"]) -> int:
    """Return the number of known positions."""
    count = 0
    for i in range(len(centre)):
        count += not math.isnan(centre[i, 2])
    return count


@compiled
def _near(gap: float) -> float:
    """Return a density of gaps with long tails, 1 for a gap of 0."""
    return 1.0 / (1.0 + (gap / _CONTACT) ** 2) ** 2


@compiled
def _contacts(
    centre: Float[NDArray, "n 3"],
    size: Float[NDArray, "n 3"],
    cos: Float[NDArray, " n"],
    sin: Float[NDArray, " n"],
) -> Float[NDArray, " n"]:
    """Return for each box how near its bottom is to the top of a box under its centre, 0 to 1."""
    n = len(cos)
    touch = np.zeros(n)
    for i in range(n):
        for j in range(n):
            dx, dy = centre[j, 0] - centre[i, 0], centre[j, 1] - centre[i, 1]
            is_over = abs(cos[i] * dx + sin[i] * dy) <= size[i, 0] / 2
            if i != j and is_over and abs(cos[i] * dy - sin[i] * dx) <= size[i, 1] / 2:
                gap = centre[j, 2] - centre[i, 2] - (size[i, 2] + size[j, 2]) / 2
                touch[j] = max(touch[j], _near(gap))
    return touch


@compiled
def _overlaps(
    centre: Float[NDArray, "n 3"],
    size: Float[NDArray, "n 3"],
    cos: Float[NDArray, " n"],
    sin: Float[NDArray, " n"],
) -> float:
    """Return the number of pairs of boxes that reach into each other."""
    n, count = len(cos), 0.0
    for i in range(n):
        for j in range(i + 1, n):
            # The other box counts as the box around it in the axes of this box.
            dx, dy = centre[j, 0] - centre[i, 0], centre[j, 1] - centre[i, 1]
            along = abs(cos[i] * cos[j] + sin[i] * sin[j])
            across = abs(cos[i] * sin[j] - sin[i] * cos[j])
            x = size[j, 0] * along + size[j, 1] * across
            y = size[j, 0] * across + size[j, 1] * along
            common_x = _common(x, size[i, 0], abs(cos[i] * dx + sin[i] * dy))
            common_y = _common(y, size[i, 1], abs(cos[i] * dy - sin[i] * dx))
            common_z = _common(size[j, 2], size[i, 2], abs(centre[j, 2] - centre[i, 2]))
            volume = size[i, 0] * size[i, 1] * size[i, 2]
            volume = min(volume, size[j, 0] * size[j, 1] * size[j, 2])
            if min(common_x, common_y, common_z) > 0.0:
                count += common_x * common_y * common_z > _OVERLAP * volume
    return count


@compiled
def _common(first: float, second: float, distance: float) -> float:
    """Return the common length of two intervals with a distance between their centres."""
    return min(first, second, (first + second) / 2 - distance)


@compiled
def _fit_of_turns(turn: Float[NDArray, "n 4"], up: int) -> float:
    """Return the log-likelihood of the tilts of boxes with a quaternion."""
    total = 0.0
    for i in range(len(turn)):
        rise = _rise(turn, i, up)
        if rise >= _UPRIGHT:
            total += _LOG_UPRIGHT
        elif not math.isnan(rise):
            total += _LOG_OVERTURNED if rise <= -_UPRIGHT else _LOG_TILTED
    return total


@compiled
def any_tilted(turn: Float[NDArray, "n 4"], up: int) -> bool:
    """Return whether a box is not upright. ``up`` is as in `Readings`."""
    count = 0
    for i in range(len(turn)):
        count += _rise(turn, i, up) < _UPRIGHT
    return count > 0


@compiled
def _rise(turn: Float[NDArray, "n 4"], i: int, up: int) -> float:
    """Return the vertical component of the upper axis of box i, NaN without a quaternion."""
    x, y, z, w = turn[i, 0], turn[i, 1], turn[i, 2], turn[i, 3]
    if up == 0:
        return 1.0 - 2.0 * (x * x + y * y)
    rise = 1.0 - 2.0 * (x * x + z * z)
    if up == 2 and not math.isnan(x):  # the axes of a box need not be those of the camera
        rise = max(abs(rise), abs(2.0 * (x * y + z * w)), abs(2.0 * (y * z - x * w)))
    return rise
