"""Free spots of missing objects at the boxes of a scene.

Statistics (`app.model.Offsets`) tell how far a missing object is from its anchor. They ignore the
box of the anchor and all other boxes. This module moves each mean to a spot where the object can
stand: neither in a box, nor in the air, nor on an occupied spot. Axes are those of the viewer.

The missing object has the typical size of its class and the yaw of its anchor. Its bottom follows
from the faces of the boxes:

- on-top: on the top face of the anchor, or on its seat (`SceneModel.seats`), which is higher in a
  high box, such as that of a bunk bed.
- inside: at the height of the statistics, but between bottom and top of the anchor.
- contains: on the floor, or at the bottom of the anchor, if the object then surrounds the anchor.
- under, if the anchor usually stands on the floor: between its legs, at its bottom. Under other
  objects, the missing object is their support, from the floor to the bottom of the anchor.
- above: at the height of the statistics, but over the top face. The class must usually hang.
- below, left, right, front and behind: a class that usually hangs has the height of the statistics,
  and a class that usually stands on the floor stands there. Any other object stands on the object
  that holds the anchor. Without such an object, it stands on a box with enough space.

Spots are the point nearest to the statistical mean, and a fixed grid. The grid covers the part of
the surface where the object does not overhang, or a strip of 1 m beside the anchor. The result is
the free spot nearest to the statistical mean.
"""

import math
from typing import Final

import numpy as np
from jaxtyping import Bool, Float, Int
from numpy.typing import NDArray

from app.compiling import compiled
from app.model.scene_model import SceneModel
from app.model.statistics import UNOBSERVED
from app.questions.posterior import Present
from app.scene.footprints import Pair
from app.scene.roles import MAX_HEIGHT
from app.scene.scene import CONTACT, MIN_OFFSET, NEIGHBOUR_GAP, Scene
from app.scene.spatial_relations import LEFT, ON_TOP, SUPPORTS
from app.scene.stands import CLEARANCE, FLOOR, HANGS, SUPPORTED, floor_level

Triple = tuple[float, float, float]

_BACK: Final = 0.10  # minimum height in metres of a back above a seat
_LEAST_SEAT: Final = 0.45  # minimum height of a seat, as a share of the height of the box
_GAP: Final = 0.02  # gap in metres to the anchor beside it, and to the top of an anchor below
_TOUCH: Final = 0.02  # maximum overlap in metres of the heights of boxes that only touch
_OFTEN: Final = 0.2  # minimum share of a stand that a class often has
_REACH: Final = 2.0  # maximum height of a support above the mean, in standard deviations
_HELD: Final = 0.8  # maximum distance of centres above each other, as a share of the larger half
_COVER: Final = 0.5  # minimum share of a surface that a flat box covers and does not occupy
_STRETCH: Final = 2.0  # maximum ratio of the free height under an anchor to the typical height
_CONE: Final = 0.98  # maximum tangent of the angle to the direction of a lateral relation
_MARGIN: Final = 0.01  # minimum gap in metres to other boxes
_NUMBERS: Final = 8  # see `_find_obstacles`
_STEPS: Final = 4  # steps of the grid from the middle of a surface to an edge
_SIDE: Final = 2 * _STEPS + 1
_FAR: Final = 9  # steps of the grid away from an anchor
_ASIDE: Final = 8  # steps of the grid to each side
_WIDTH: Final = 2 * _ASIDE + 1
_UNIFORM: Final = 1 / math.sqrt(3)  # standard deviation of a uniform distribution on [-1, 1]

# Roles of a missing object: 2 (relation - ON_TOP), plus 1 if the anchor is the subject.
_ON, _UNDER, _ABOVE, _BELOW, _IN, _AROUND, _BESIDE = range(7)

# Columns of the table of boxes: centre, horizontal extents, cos and sin of the yaw, heights of
# bottom, top, surface and floor, usual stand, and number of the holder or -1. NaN: unknown.
_COLUMNS: Final = 13
_X, _Y, _Z, _SIZE_X, _SIZE_Y, _COS, _SIN, _LOW, _HIGH, _SURFACE, _FLOOR, _STAND, _HOLDER = range(13)


def move_to_free_spots(
    model: SceneModel,
    scene: Scene,
    present: Present,
    boxes: tuple[Float[NDArray, "N 3"], Float[NDArray, "N 3"]],  # see `boxes_of`
    relation: Int[NDArray, " n"],
    missing: Int[NDArray, " n"],  # classes
    outgoing: Bool[NDArray, " n"],  # whether the missing object is the relation's subject
    anchor: Int[NDArray, " n"],  # indices in `Scene.objects`
    mean: Float[NDArray, "n 3"],  # offsets from the anchors
    std: Float[NDArray, "n 3"],
    scenes: Int[NDArray, " n"],  # becomes `UNOBSERVED` without a free spot
) -> None:
    """Move the means of offsets to free spots, and limit their spread to the surface, in place.

    An offset stays as it is if the request does not state the size of the anchor, or if the size of
    the missing object is unknown. For stacked relations, the horizontal standard deviation is at
    most that of a uniform distribution over the possible centres.
    """
    if model.places is None:
        return
    classes = model.vocabulary.stand_in[present.classes][present.row]
    holders = np.full(len(classes), -1)
    for a, i, j in scene.triples:
        if a in SUPPORTS:
            holders[i] = j
    yaws = np.array([thing.yaw for thing in scene.objects])
    has_size = np.array([thing.size is not None for thing in scene.objects])
    stands = model.places.stands
    table = _table(*boxes, yaws, model.seats[classes], stands[classes], holders)
    sizes = model.vocabulary.sizes[missing]
    places = relation, outgoing, anchor, sizes, stands[missing]
    _move(table, has_size, *places, mean, std, scenes)


@compiled
def _table(
    centres: Float[NDArray, "n 3"],
    sizes: Float[NDArray, "n 3"],
    yaws: Float[NDArray, " n"],
    seats: Float[NDArray, " n"],  # `SceneModel.seats`
    stands: Float[NDArray, "n 3"],  # `Places.stands`
    holders: Int[NDArray, " n"],  # number of the object on or in which each object is, or -1
) -> Float[NDArray, "n columns"]:
    """Return the table of the boxes of a scene. NaN: unknown."""
    boxes = np.empty((len(yaws), _COLUMNS))
    for i in range(len(yaws)):
        half = sizes[i, 2] / 2
        boxes[i, _X], boxes[i, _Y], boxes[i, _Z] = centres[i]
        boxes[i, _SIZE_X], boxes[i, _SIZE_Y] = sizes[i, :2]
        boxes[i, _COS], boxes[i, _SIN] = math.cos(yaws[i]), math.sin(yaws[i])
        boxes[i, _LOW], boxes[i, _HIGH] = centres[i, 2] - half, centres[i, 2] + half
        seat = boxes[i, _LOW] + max(seats[i], _LEAST_SEAT * sizes[i, 2])
        boxes[i, _STAND] = stands[i].argmax()
        boxes[i, _SURFACE] = seat if seat <= boxes[i, _HIGH] - _BACK else boxes[i, _HIGH]
    floor = floor_level(boxes[:, _LOW], stands[:, FLOOR], np.full(len(yaws), CONTACT))
    for i in range(len(yaws)):
        low, stand, j = boxes[i, _LOW], boxes[i, _STAND], holders[i]
        # The bottom of a box on the floor is the best estimate near this box.
        is_on_floor = low <= floor + CLEARANCE and stand != HANGS
        if math.isnan(floor):
            is_on_floor = stand == FLOOR
        boxes[i, _FLOOR] = low if is_on_floor else floor
        # A rug holds no box, nor does a bin under a desk, although the desk is "on top of" the bin.
        boxes[i, _HOLDER] = j if j >= 0 and low >= boxes[j, _LOW] + CLEARANCE else -1
    return boxes


@compiled
def _move(
    boxes: Float[NDArray, "N columns"],
    has_size: Bool[NDArray, " N"],  # whether the request states the size
    relation: Int[NDArray, " n"],
    outgoing: Bool[NDArray, " n"],
    anchor: Int[NDArray, " n"],
    sizes: Float[NDArray, "n 3"],  # typical sizes of the missing objects
    stands: Float[NDArray, "n 3"],  # `Places.stands` of the missing objects
    mean: Float[NDArray, "n 3"],
    std: Float[NDArray, "n 3"],
    scenes: Int[NDArray, " n"],
) -> None:
    """Move means and limit standard deviations, in place; see `move_to_free_spots`."""
    for k in range(len(relation)):
        i, size = anchor[k], (sizes[k, 0], sizes[k, 1], sizes[k, 2])
        known = boxes[i, _Z] + sum(size)  # NaN: a position or a size is unknown
        if scenes[k] == UNOBSERVED or not has_size[i] or math.isnan(known):
            continue
        role, direction = _BESIDE, _direction(relation[k], outgoing[k])
        if relation[k] >= ON_TOP:
            role = 2 * (relation[k] - ON_TOP) + (0 if outgoing[k] else 1)
        learned = boxes[i, _Z] + mean[k, 2] - size[2] / 2
        reach = learned + _REACH * std[k, 2]
        heights = _heights(boxes, i, role, size[2], stands[k], learned, reach)
        limits = _limits(boxes, i, role, size, direction)
        if role != _BESIDE:
            cos, sin = abs(boxes[i, _COS]), abs(boxes[i, _SIN])
            std[k, 0] = min(std[k, 0], _UNIFORM * (cos * limits[0] + sin * limits[1]))
            std[k, 1] = min(std[k, 1], _UNIFORM * (sin * limits[0] + cos * limits[1]))
        spot = _nearest_spot(boxes, i, role, size, heights, limits, direction, mean[k])
        if math.isnan(spot[2]):
            scenes[k] = UNOBSERVED
        else:
            mean[k, 0], mean[k, 1], mean[k, 2] = spot


@compiled
def _direction(relation: int, outgoing: bool) -> Pair:
    """Return the direction (ahead, left) from the anchor to an object left or in front of it."""
    sign = 1.0 if outgoing else -1.0
    return (0.0, sign) if relation == LEFT else (-sign, 0.0)


# ----------------------------------------------------------------------------------------- heights


@compiled
def _heights(
    boxes: Float[NDArray, "N columns"],
    i: int,  # the anchor
    role: int,
    height: float,
    stands: Float[NDArray, " 3"],
    learned: float,  # bottom of the missing object by the statistics
    reach: float,  # maximum height of a support
) -> Triple:
    """Return bottom and top of a missing object, NaN without a possible height, and a limit.

    If the limit is not NaN, the object stands on the highest surface below this limit. Without such
    a surface, it stands at the bottom, which is then the floor or NaN.
    """
    low, high, ground, of_anchor = (
        boxes[i, _LOW],
        boxes[i, _HIGH],
        boxes[i, _FLOOR],
        boxes[i, _STAND],
    )
    usual, bottom = stands.argmax(), math.nan
    if role == _BESIDE:
        return _heights_beside(boxes, i, height, stands, learned, reach)
    if role == _BELOW or (role == _UNDER and of_anchor == HANGS):
        return _heights_below(low - CONTACT - _GAP - height, height, ground, stands, learned)
    if role == _UNDER:
        return _heights_under(low, high, height, ground, usual == FLOOR, of_anchor == FLOOR)
    if role == _ON:
        bottom = boxes[i, _SURFACE]
    elif role == _IN:
        bottom = min(max(learned, low), max(low, high - height))
    elif role == _AROUND:
        bottom = low if usual == SUPPORTED else min(learned, low)
        if ground <= low + _TOUCH:
            bottom = ground if usual == FLOOR else max(bottom, ground)
        if bottom + MAX_HEIGHT * height < high:
            bottom = math.nan
    elif usual == HANGS:  # above the anchor
        bottom = max(learned, high + CONTACT + _GAP)
    return bottom, bottom + height, math.nan


@compiled
def _heights_beside(
    boxes: Float[NDArray, "N columns"],
    i: int,
    height: float,
    stands: Float[NDArray, " 3"],
    learned: float,
    reach: float,
) -> Triple:
    """Return the heights of an object beside an anchor; see `_heights`."""
    low, ground, usual, limit = boxes[i, _LOW], boxes[i, _FLOOR], stands.argmax(), math.nan
    is_raised = boxes[i, _HOLDER] >= 0 or (boxes[i, _STAND] == SUPPORTED and low != ground)
    if usual == HANGS:
        bottom = ground if learned <= ground + CLEARANCE else learned
    elif is_raised and stands[SUPPORTED] >= _OFTEN:
        bottom = low
    elif usual == FLOOR:
        bottom = learned if math.isnan(ground) else ground
    else:
        bottom, limit = ground if stands[FLOOR] >= _OFTEN else math.nan, reach
    return bottom, bottom + height, limit


@compiled
def _heights_below(
    highest: float, height: float, ground: float, stands: Float[NDArray, " 3"], learned: float
) -> Triple:
    """Return the heights of an object with its bottom at most at `highest`; see `_heights`."""
    bottom, usual = ground if stands[FLOOR] >= _OFTEN else math.nan, stands.argmax()
    limit = highest if usual == SUPPORTED else math.nan
    if usual == HANGS:
        bottom = min(learned, highest)
    if bottom > highest or bottom < ground:
        bottom = math.nan
    return bottom, bottom + height, limit


@compiled
def _heights_under(
    low: float, high: float, height: float, ground: float, is_furniture: bool, has_legs: bool
) -> Triple:
    """Return the heights between the legs of an anchor, or of a support of an anchor."""
    bottom, top = low - height, low
    if has_legs:
        bottom = low if math.isnan(ground) else ground
        top = bottom + height
        if height > MAX_HEIGHT * (high - bottom):
            bottom = math.nan
    elif is_furniture and not math.isnan(ground):
        bottom, free = ground, low - ground
        if not height <= _STRETCH * free <= _STRETCH**2 * height:
            bottom = math.nan
    elif bottom < ground:
        bottom = math.nan
    return bottom, top, math.nan


# ------------------------------------------------------------------------------------------- spots


@compiled
def _limits(
    boxes: Float[NDArray, "N columns"], i: int, role: int, size: Triple, direction: Pair
) -> Pair:
    """Return the maximum distances of the centres in the axes of the anchor.

    Beside the anchor, these are the distances along and across the direction at which both boxes
    touch.
    """
    x, y = boxes[i, _SIZE_X], boxes[i, _SIZE_Y]
    if role in (_ON, _IN):
        return max(x - size[0], 0.0) / 2, max(y - size[1], 0.0) / 2
    if role == _AROUND:
        return max(size[0] - x, 0.0) / 2, max(size[1] - y, 0.0) / 2
    if role == _UNDER:
        return abs(x - size[0]) / 2, abs(y - size[1]) / 2
    if role != _BESIDE:
        return _HELD * max(x, size[0]) / 2, _HELD * max(y, size[1]) / 2
    x, y = _extents(x + size[0], y + size[1], boxes[i, _COS], boxes[i, _SIN])
    return (x / 2, y / 2) if direction[0] else (y / 2, x / 2)


@compiled
def _extents(x: float, y: float, cos: float, sin: float) -> Pair:
    """Return the extents along the axes of a footprint with this cos and sin of the yaw."""
    cos, sin = abs(cos), abs(sin)
    return cos * x + sin * y, sin * x + cos * y


@compiled
def _nearest_spot(
    boxes: Float[NDArray, "N columns"],
    i: int,
    role: int,
    size: Triple,
    heights: Triple,  # see `_heights`
    limits: Pair,  # see `_limits`
    direction: Pair,
    mean: Float[NDArray, " 3"],
) -> Triple:
    """Return the offset of the free spot nearest to a mean, or NaN without a free spot."""
    nearest, spot = math.inf, (math.nan, math.nan, math.nan)
    bottom, top, limit = heights
    holder, turn = int(boxes[i, _HOLDER]), (boxes[i, _COS], boxes[i, _SIN])
    is_held = role == _BESIDE and holder >= 0 and bottom == boxes[i, _LOW]
    base = i if role == _ON else holder if is_held else -1
    obstacles, count, base_of_obstacles = np.empty((len(boxes), _NUMBERS)), 0, -2
    for number in range(-1, (_FAR + 1) * _WIDTH if role == _BESIDE else _SIDE**2):
        if role == _BESIDE:
            x, y = _beside(number, limits, direction, mean)
        else:
            x, y = _over(number, limits, turn, mean)
        distance = math.hypot(x - mean[0], y - mean[1])
        if not distance < nearest:
            continue
        point = (boxes[i, _X] + x, boxes[i, _Y] + y)
        if is_held and not _fits_on(boxes, base, point, size, turn):
            continue
        if not math.isnan(limit):
            base = _carrier(boxes, point, size, turn, limit)
            bottom = heights[0] if base < 0 else boxes[base, _SURFACE]
            top = bottom + size[2]
        if not bottom <= top:
            continue
        if base != base_of_obstacles:
            count = _find_obstacles(boxes, i, role, size, bottom, top, base, obstacles)
            base_of_obstacles = base
        if _is_free(obstacles[:count], point, turn):
            nearest, spot = distance, (x, y, (bottom + top) / 2 - boxes[i, _Z])
    return spot


@compiled
def _over(number: int, limits: Pair, turn: Pair, mean: Float[NDArray, " 3"]) -> Pair:
    """Return the offset of a spot over, in or under an anchor; -1 is nearest to the mean."""
    cos, sin = turn  # of the yaw of the anchor
    p = (number // _SIDE - _STEPS) / _STEPS * limits[0]
    q = (number % _SIDE - _STEPS) / _STEPS * limits[1]
    if number < 0:
        p = min(max(cos * mean[0] + sin * mean[1], -limits[0]), limits[0])
        q = min(max(cos * mean[1] - sin * mean[0], -limits[1]), limits[1])
    return cos * p - sin * q, sin * p + cos * q


@compiled
def _beside(number: int, limits: Pair, direction: Pair, mean: Float[NDArray, " 3"]) -> Pair:
    """Return the offset of a spot beside an anchor, NaN if too far; -1 is nearest to the mean."""
    ahead, left = direction
    least = max(limits[0], MIN_OFFSET) + _GAP
    out = least + number // _WIDTH / _FAR * (NEIGHBOUR_GAP - 2 * _GAP)
    aside = (number % _WIDTH - _ASIDE) / _ASIDE * _CONE * out
    if number < 0:
        out = min(max(mean[0] * ahead + mean[1] * left, least), least + NEIGHBOUR_GAP - 2 * _GAP)
        aside = min(max(mean[1] * ahead - mean[0] * left, -_CONE * out), _CONE * out)
    if math.hypot(out - limits[0], max(abs(aside) - limits[1], 0.0)) > NEIGHBOUR_GAP:
        return math.nan, math.nan
    return ahead * out - left * aside, left * out + ahead * aside


@compiled
def _fits_on(
    boxes: Float[NDArray, "N columns"], k: int, point: Pair, size: Triple, turn: Pair
) -> bool:
    """Return whether a footprint at a point is on the footprint of box k, without overhang."""
    dx, dy, cos, sin = (
        point[0] - boxes[k, _X],
        point[1] - boxes[k, _Y],
        boxes[k, _COS],
        boxes[k, _SIN],
    )
    x, y = _extents(size[0], size[1], *_difference(turn, (cos, sin)))
    fits_x = abs(cos * dx + sin * dy) + x / 2 <= boxes[k, _SIZE_X] / 2
    return fits_x and abs(cos * dy - sin * dx) + y / 2 <= boxes[k, _SIZE_Y] / 2


@compiled
def _difference(turn: Pair, other: Pair) -> Pair:
    """Return cos and sin of the difference of two angles with these values of cos and sin."""
    return turn[0] * other[0] + turn[1] * other[1], turn[1] * other[0] - turn[0] * other[1]


@compiled
def _carrier(
    boxes: Float[NDArray, "N columns"], point: Pair, size: Triple, turn: Pair, limit: float
) -> int:
    """Return the box with the highest surface below a limit on which a footprint fits, or -1."""
    carrier, highest = -1, -math.inf
    for k in range(len(boxes)):
        surface = boxes[k, _SURFACE]
        is_floor = surface <= boxes[k, _FLOOR] + CLEARANCE
        if highest < surface <= limit and not is_floor and _fits_on(boxes, k, point, size, turn):
            carrier, highest = k, surface
    return carrier


@compiled
def _find_obstacles(
    boxes: Float[NDArray, "N columns"],
    i: int,
    role: int,
    size: Triple,
    bottom: float,
    top: float,
    base: int,  # the box with the surface of the spot, or -1 on the floor
    obstacles: Float[NDArray, "n 8"],  # receives the results
) -> int:
    """Find the boxes at the height of a spot, but those that hold or surround the anchor.

    Each result has the centre of a box, cos and sin of its yaw, and the minimum distances of
    the box and the missing object, along the axes of the box and of the object.
    """
    area, count = size[0] * size[1], 0
    holder = int(boxes[i, _HOLDER]) if role in (_ON, _IN) else -1
    surface = area / _COVER if base < 0 else boxes[base, _SIZE_X] * boxes[base, _SIZE_Y]
    for k in range(len(boxes)):
        low, high, x, y = boxes[k, _LOW], boxes[k, _HIGH], boxes[k, _SIZE_X], boxes[k, _SIZE_Y]
        other = x * y
        # A box closely above the surface stands on it.
        overlap = min(top, high) - (bottom if low <= bottom + CONTACT else low)
        if not overlap > min(_TOUCH, min(top - bottom, high - low) / 2):
            continue
        # Objects stand on a rug or a tablecloth, and a container can hold several objects.
        is_cover = high - low <= CONTACT and other >= _COVER * surface
        covers = top - bottom <= CONTACT and area >= max(other, _COVER * surface)
        is_inside = low >= bottom - _TOUCH and high <= top + _TOUCH and other <= area
        if is_cover or covers or (is_inside and role == _AROUND):
            continue
        if k not in (base, holder) and (k != i or role == _BESIDE):
            row, turn = obstacles[count], (boxes[k, _COS], boxes[k, _SIN])
            cos, sin = _difference(turn, (boxes[i, _COS], boxes[i, _SIN]))
            width, depth = _extents(size[0], size[1], cos, sin)
            own_width, own_depth = _extents(x, y, cos, sin)
            row[0], row[1], row[2], row[3] = boxes[k, _X], boxes[k, _Y], turn[0], turn[1]
            row[4], row[5] = (x + width) / 2 + _MARGIN, (y + depth) / 2 + _MARGIN
            row[6] = (size[0] + own_width) / 2 + _MARGIN
            row[7] = (size[1] + own_depth) / 2 + _MARGIN
            count += 1
    return count


@compiled
def _is_free(obstacles: Float[NDArray, "m 8"], point: Pair, turn: Pair) -> bool:
    """Return whether a footprint has a gap to each obstacle.

    Two rectangles overlap if and only if their projections on each of their four sides overlap.
    """
    for k in range(len(obstacles)):
        x, y, cos, sin, reach_x, reach_y, own_x, own_y = obstacles[k]
        dx, dy = point[0] - x, point[1] - y
        meets = abs(cos * dx + sin * dy) < reach_x and abs(cos * dy - sin * dx) < reach_y
        cos, sin = turn
        meets = meets and abs(cos * dx + sin * dy) < own_x
        if meets and abs(cos * dy - sin * dx) < own_y:
            return False
    return True
