"""Free spots of missing objects at the boxes of a scene.

Statistics (`app.model.Offsets`) tell how far a missing object is from its anchor. They ignore the
box of the anchor and all other boxes. This module moves each mean to a spot where the object can
stand: neither in a box, nor in the air, nor on an occupied spot. Axes are those of the viewer.

The missing object has the typical size of its class and the yaw of its anchor. Its bottom follows
from the faces of the boxes:

- on-top: on the top face of the anchor, or on its seat (`SceneModel.seats`).
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
from typing import Final, NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int
from numpy.typing import NDArray

from app.compiling import compiled
from app.model.scene_model import SceneModel
from app.model.statistics import UNOBSERVED
from app.questions.posterior import Present
from app.scene.footprints import Pair, measure
from app.scene.roles import MAX_HEIGHT
from app.scene.scene import CONTACT, MIN_OFFSET, NEIGHBOUR_GAP, SMALLEST, Scene, boxes_of
from app.scene.spatial_relations import LEFT, ON_TOP, SUPPORTS
from app.scene.stands import CLEARANCE, FLOOR, HANGS, SUPPORTED, floor_level

Triple = tuple[float, float, float]

_BACK: Final = 0.10  # minimum height in metres of a back above a seat
_GAP: Final = 0.02  # gap in metres to the anchor beside it, and to the top of an anchor below
_TOUCH: Final = 0.02  # maximum overlap in metres of the heights of boxes that only touch
_OFTEN: Final = 0.2  # minimum share of a stand that a class often has
_REACH: Final = 2.0  # maximum height of a support above the mean, in standard deviations
_HELD: Final = 0.8  # maximum distance of centres above each other, as a share of the larger half
_COVER: Final = 0.5  # minimum share of a surface that a flat box covers and does not occupy
_STRETCH: Final = 2.0  # maximum ratio of the free height under an anchor to the typical height
_CONE: Final = 0.98  # maximum tangent of the angle to the direction of a lateral relation
_NO_OVERLAP: Final = 1e-3  # maximum overlap of footprints that counts as rounding
_STEPS: Final = 4  # steps of the grid from the middle of a surface to an edge
_SIDE: Final = 2 * _STEPS + 1
_FAR: Final = 9  # steps of the grid away from an anchor
_ASIDE: Final = 8  # steps of the grid to each side
_WIDTH: Final = 2 * _ASIDE + 1
_UNIFORM: Final = 1 / math.sqrt(3)  # standard deviation of a uniform distribution on [-1, 1]

# Roles of a missing object: 2 (relation - ON_TOP), plus 1 if the anchor is the subject.
_ON, _UNDER, _ABOVE, _BELOW, _IN, _AROUND, _BESIDE = range(7)


class Boxes(NamedTuple):
    """The boxes of the n objects of a scene, in the axes of the viewer. NaN: unknown."""

    centres: Float[NDArray, "n 3"]
    sizes: Float[NDArray, "n 3"]  # typical sizes for sizes that the request lacks
    yaws: Float[NDArray, " n"]
    has_size: Bool[NDArray, " n"]  # whether the request states the size
    seats: Float[NDArray, " n"]  # `SceneModel.seats`
    stands: Float[NDArray, "n 3"]  # `Places.stands`
    holders: Int[NDArray, " n"]  # number of the object on or in which each object is, or -1
    floor: float  # height of the floor

    @classmethod
    def of(cls, model: SceneModel, scene: Scene, present: Present) -> "Boxes | None":
        """Return the boxes of a scene, or None if no object has both a position and a size."""
        has_size = np.array([
            thing.position is not None and thing.size is not None and max(thing.size) >= SMALLEST
            for thing in scene.objects
        ])  # fmt: skip
        if model.places is None or not has_size.any():
            return None
        centres, sizes = boxes_of(scene.objects, model.vocabulary.sizes)
        classes = model.vocabulary.stand_in[present.classes][present.row]
        holders, stands = np.full(len(classes), -1), model.places.stands[classes].astype(float)
        for a, i, j in scene.triples:
            if a in SUPPORTS:
                holders[i] = j
        return cls(
            centres,
            sizes,
            np.array([thing.yaw for thing in scene.objects]),
            has_size,
            model.seats[classes],
            stands,
            holders,
            floor_level(centres[:, 2] - sizes[:, 2] / 2, stands[:, FLOOR]),
        )


def move_to_free_spots(
    model: SceneModel,
    scene: Scene,
    present: Present,
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
    boxes = Boxes.of(model, scene, present)
    if boxes is not None and model.places is not None:
        sizes, stands = model.vocabulary.sizes[missing], model.places.stands[missing]
        _move(boxes, relation, outgoing, anchor, sizes, stands, mean, std, scenes)


@compiled
def _move(
    boxes: Boxes,
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
        if scenes[k] == UNOBSERVED or not boxes.has_size[i] or math.isnan(sum(size)):
            continue
        role, direction = _BESIDE, _direction(relation[k], outgoing[k])
        if relation[k] >= ON_TOP:
            role = 2 * (relation[k] - ON_TOP) + (0 if outgoing[k] else 1)
        learned = boxes.centres[i, 2] + mean[k, 2] - size[2] / 2
        reach = learned + _REACH * std[k, 2]
        heights = _heights(boxes, i, role, size[2], stands[k], learned, reach)
        limits = _limits(boxes, i, role, size, direction)
        cos, sin = abs(math.cos(boxes.yaws[i])), abs(math.sin(boxes.yaws[i]))
        if role != _BESIDE:
            std[k, 0] = min(std[k, 0], _UNIFORM * (cos * limits[0] + sin * limits[1]))
            std[k, 1] = min(std[k, 1], _UNIFORM * (sin * limits[0] + cos * limits[1]))
        spot = _nearest_spot(boxes, i, role, size, heights, limits, direction, mean[k])
        if math.isnan(spot[2]):
            scenes[k] = UNOBSERVED
        mean[k, 0], mean[k, 1], mean[k, 2] = spot


@compiled
def _direction(relation: int, outgoing: bool) -> Pair:
    """Return the direction (ahead, left) from the anchor to an object left or in front of it."""
    sign = 1.0 if outgoing else -1.0
    return (0.0, sign) if relation == LEFT else (-sign, 0.0)


# ----------------------------------------------------------------------------------------- heights


@compiled
def _heights(
    boxes: Boxes,
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
    low = _bottom(boxes, i)
    high, usual, of_anchor = low + boxes.sizes[i, 2], stands.argmax(), boxes.stands[i].argmax()
    ground, bottom, limit = _ground(boxes, i), math.nan, math.nan
    on_floor = ground if stands[FLOOR] >= _OFTEN else math.nan
    is_raised = _holder(boxes, i) >= 0 or (of_anchor == SUPPORTED and low != ground)
    if role == _ON:
        bottom = surface_of(boxes, i)
    elif role == _IN:
        bottom = min(max(learned, low), max(low, high - height))
    elif role == _UNDER and of_anchor != HANGS:
        return _under(low, high, height, ground, usual == FLOOR, of_anchor == FLOOR)
    elif role == _AROUND:
        bottom = low if usual == SUPPORTED else min(learned, low)
        if usual == FLOOR and ground <= low + _TOUCH:
            bottom = ground
        if bottom + MAX_HEIGHT * height < high:
            bottom = math.nan
    elif role == _ABOVE:
        if usual == HANGS:
            bottom = max(learned, high + CONTACT + _GAP)
    elif role in (_BELOW, _UNDER):
        highest = low - CONTACT - _GAP - height
        if usual == HANGS:
            bottom = min(learned, highest)
        else:
            bottom, limit = on_floor, (math.nan if usual == FLOOR else highest)
        if bottom > highest or bottom < ground:
            bottom = math.nan
    elif usual == HANGS:
        bottom = learned if math.isnan(ground) else max(learned, ground)
    elif is_raised and stands[SUPPORTED] >= _OFTEN:
        bottom = low
    elif usual == FLOOR:
        bottom = learned if math.isnan(ground) else ground
    else:
        bottom, limit = on_floor, reach
    return bottom, bottom + height, limit


@compiled
def _under(
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


@compiled
def surface_of(boxes: Boxes, i: int) -> float:
    """Return the height of the seat of a box below its back, or of its top face."""
    seat, top = _bottom(boxes, i) + boxes.seats[i], boxes.centres[i, 2] + boxes.sizes[i, 2] / 2
    return seat if seat <= top - _BACK else top


@compiled
def _bottom(boxes: Boxes, i: int) -> float:
    return boxes.centres[i, 2] - boxes.sizes[i, 2] / 2


@compiled
def _ground(boxes: Boxes, i: int) -> float:
    """Return the height of the floor: the bottom of a box on the floor, or NaN if unknown."""
    low, usual = _bottom(boxes, i), boxes.stands[i].argmax()
    if math.isnan(boxes.floor):
        return low if usual == FLOOR else math.nan
    return low if usual != HANGS and low <= boxes.floor + CLEARANCE else boxes.floor


@compiled
def _holder(boxes: Boxes, i: int) -> int:
    """Return the box that holds a box well above its own bottom, or -1.

    A rug holds no box, nor does a bin under a desk, although the desk is "on top of" the bin.
    """
    j = boxes.holders[i]
    if j < 0:
        return -1
    return j if _bottom(boxes, i) >= _bottom(boxes, j) + CLEARANCE else -1


# ------------------------------------------------------------------------------------------- spots


@compiled
def _limits(boxes: Boxes, i: int, role: int, size: Triple, direction: Pair) -> Pair:
    """Return the maximum distances of the centres in the axes of the anchor.

    Beside the anchor, these are the distances along and across the direction at which both boxes
    touch.
    """
    x, y = boxes.sizes[i, 0], boxes.sizes[i, 1]
    if role in (_ON, _IN):
        return max(x - size[0], 0.0) / 2, max(y - size[1], 0.0) / 2
    if role == _AROUND:
        return max(size[0] - x, 0.0) / 2, max(size[1] - y, 0.0) / 2
    if role == _UNDER:
        return abs(x - size[0]) / 2, abs(y - size[1]) / 2
    if role != _BESIDE:
        return _HELD * max(x, size[0]) / 2, _HELD * max(y, size[1]) / 2
    x, y = _extents(x + size[0], y + size[1], boxes.yaws[i])
    return (x / 2, y / 2) if direction[0] else (y / 2, x / 2)


@compiled
def _extents(x: float, y: float, yaw: float) -> Pair:
    """Return the extents of a rotated footprint along the axes."""
    cos, sin = abs(math.cos(yaw)), abs(math.sin(yaw))
    return cos * x + sin * y, sin * x + cos * y


@compiled
def _nearest_spot(
    boxes: Boxes,
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
    holder = _holder(boxes, i)
    holds = (
        role == _BESIDE and holder >= 0 and bottom == boxes.centres[i, 2] - boxes.sizes[i, 2] / 2
    )
    for number in range(-1, (_FAR + 1) * _WIDTH if role == _BESIDE else _SIDE**2):
        if role == _BESIDE:
            x, y = _beside(number, limits, direction, mean)
        else:
            x, y = _over(number, limits, boxes.yaws[i], mean)
        distance = math.hypot(x - mean[0], y - mean[1])
        if not distance < nearest:
            continue
        point, base = (boxes.centres[i, 0] + x, boxes.centres[i, 1] + y), -1
        if holds:
            base = holder
            if not _fits_on(boxes, base, point, size, boxes.yaws[i]):
                continue
        elif role == _ON:
            base = i
        elif not math.isnan(limit):
            bottom, base = heights[0], _carrier(boxes, i, point, size, limit)
            if base >= 0:
                bottom = surface_of(boxes, base)
            top = bottom + size[2]
        if bottom <= top and _is_free(boxes, i, role, point, size, bottom, top, base):
            nearest, spot = distance, (x, y, (bottom + top) / 2 - boxes.centres[i, 2])
    return spot


@compiled
def _over(number: int, limits: Pair, yaw: float, mean: Float[NDArray, " 3"]) -> Pair:
    """Return the offset of a spot over, in or under an anchor; -1 is nearest to the mean."""
    cos, sin = math.cos(yaw), math.sin(yaw)
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
def _fits_on(boxes: Boxes, k: int, point: Pair, size: Triple, yaw: float) -> bool:
    """Return whether a footprint at a point is on the footprint of box k, without overhang."""
    dx, dy = point[0] - boxes.centres[k, 0], point[1] - boxes.centres[k, 1]
    cos, sin = math.cos(boxes.yaws[k]), math.sin(boxes.yaws[k])
    x, y = _extents(size[0], size[1], yaw - boxes.yaws[k])
    fits_x = abs(cos * dx + sin * dy) + x / 2 <= boxes.sizes[k, 0] / 2
    return fits_x and abs(cos * dy - sin * dx) + y / 2 <= boxes.sizes[k, 1] / 2


@compiled
def _carrier(boxes: Boxes, i: int, point: Pair, size: Triple, limit: float) -> int:
    """Return the box with the highest surface below a limit on which a footprint fits, or -1."""
    found, highest = -1, boxes.floor + CLEARANCE if boxes.floor > -math.inf else -math.inf
    for k in range(len(boxes.yaws)):
        surface = surface_of(boxes, k)
        if highest < surface <= limit and _fits_on(boxes, k, point, size, boxes.yaws[i]):
            found, highest = k, surface
    return found


@compiled
def _is_free(
    boxes: Boxes,
    i: int,
    role: int,
    point: Pair,
    size: Triple,
    bottom: float,
    top: float,
    base: int,  # the box with the surface of the spot, or -1 on the floor
) -> bool:
    """Return whether no box is at the spot, but those that hold or surround the anchor."""
    area, yaw = size[0] * size[1], boxes.yaws[i]
    holder = _holder(boxes, i) if role in (_ON, _IN, _ABOVE) else -1
    surface = area / _COVER if base < 0 else boxes.sizes[base, 0] * boxes.sizes[base, 1]
    radius = math.hypot(size[0], size[1]) / 2
    for k in range(len(boxes.yaws)):
        centre, extents = boxes.centres[k], boxes.sizes[k]
        low, high = centre[2] - extents[2] / 2, centre[2] + extents[2] / 2
        overlap = min(top, high) - max(bottom, low)
        if not overlap > min(_TOUCH, min(top - bottom, high - low) / 2):
            continue
        distance = math.hypot(point[0] - centre[0], point[1] - centre[1])
        if not distance < radius + math.hypot(extents[0], extents[1]) / 2:
            continue
        # Objects stand on a rug or a tablecloth.
        other = extents[0] * extents[1]
        is_cover = extents[2] <= CONTACT and other >= _COVER * surface
        covers = top - bottom <= CONTACT and area >= max(other, _COVER * surface)
        if is_cover or covers or k in (base, holder) or (k == i and role != _BESIDE):
            continue
        if measure(point, size, yaw, centre, extents, boxes.yaws[k])[0] <= _NO_OVERLAP:
            continue
        # A missing container can also hold other objects.
        is_held = low >= bottom - _TOUCH and high <= top + _TOUCH
        if not (role == _AROUND and is_held and other <= area):
            return False
    return True
