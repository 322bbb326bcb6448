"""Warnings about probable mistakes in the poses and sizes of a scene.

Some checks compare the sizes of objects with the typical sizes of their classes. They find wrong
units, a frame whose y axis points up, and quaternions in a wrong order.
"""

import math
from collections.abc import Mapping, Sequence
from itertools import compress
from statistics import median
from typing import Final

from app.scene.scene import LARGEST, MOST_DISTANT, SMALLEST, Point, Scene, SceneObject
from app.scene.vocabulary import Vocabulary
from scene_client.frames import is_optical, is_world_fixed
from scene_client.schemas import Detection, SceneRequest, SceneWarning
from scene_client.schemas.answers import WarningCode

_ORIGIN: Final[Point] = (0.0, 0.0, 0.0)
_SAME_DEPTH: Final = 1e-3  # maximum difference in m of depths that count as equal
_LEAST: Final = 3  # minimum number of objects for warnings about all objects of a scene
_FURNITURE: Final = 0.5  # minimum longest side of furniture in m; smaller objects may lie or stand
_MOST: Final = 0.75  # minimum share of the objects that agree on a mistake
_UNIT: Final = math.log(2.5)  # minimum log ratio to the typical sizes that means another unit
_TWICE: Final = math.log(2.0)  # log ratio that is more than the spread within a class
_BETTER: Final = math.log(1.5)  # minimum mean advantage of the y extents over the z extents
_UPRIGHT: Final = 0.05  # maximum component of a quaternion that counts as 0

_TOO_FAR: Final = (
    f"the object is more than {MOST_DISTANT:g} m from the viewer; positions must be in metres"
)
_ODD_SIZE: Final = (
    f"all sides of the object are below {SMALLEST * 1e3:g} mm, so its size is unknown, or a side "
    f"is above {LARGEST:g} m; sizes must be in metres"
)
_SCALED: Final = (
    "the sizes of these objects are about {:.2g} times the typical sizes of their classes; sizes "
    "must be in metres"
)
_Y_UP: Final = (
    "the sizes of these objects fit their classes only if the y axis points up; convert positions, "
    "sizes and orientations to a frame whose z axis points up"
)
_ROLLED: Final = (
    "these objects lie on their sides, but their sizes fit upright objects; the order of a "
    "quaternion is x, y, z, w, and the z axis of an optical frame points ahead"
)
_FLAT: Final = "all objects have the same depth along the optical axis; the depth may be missing"
_UNSIZED: Final = (
    "the service cannot derive vertical relations of this object: the object has no size, and its "
    "class has no typical size"
)


def scene_warnings(
    scene: Scene,
    detections: Mapping[int, Detection],  # by index in the scene, without bare labels
    vocabulary: Vocabulary,
    request: SceneRequest,
    *,
    derived: bool,  # whether relations were derived from the poses
) -> list[SceneWarning]:
    """Return the warnings about a scene in the frame of the request (x forward, y left, z up)."""
    # Python loops are fast enough, because most scenes have no poses or pass all checks.
    placed = [thing for thing in scene.objects if thing.position is not None]
    sized = _sized(scene, detections, vocabulary)
    factor, scaled = _scaled(sized)
    fits = _fits(sized)
    odd = [
        one
        for one in scene.objects
        if one.size is not None and not SMALLEST <= max(one.size) <= LARGEST and one not in scaled
    ]
    rolled = _rolled(fits, detections)
    optical = is_optical(request.frame_id)
    y_up = () if optical else _y_up([fit for fit in fits if fit[0] not in rolled])
    unsized = _unsized(placed, vocabulary) if derived and len(placed) > 1 else ()
    kinds: list[tuple[WarningCode, str, Sequence[SceneObject]]] = [
        ("implausible-position", _TOO_FAR, _distant(placed, request)),
        ("implausible-size", _ODD_SIZE, odd),
        ("implausible-scale", _SCALED.format(factor), scaled),
        ("y-axis-up", _Y_UP, y_up),
        ("rolled-objects", _ROLLED, rolled),
        ("flat-scene", _FLAT, placed if optical and _is_flat(placed) else ()),
        ("unknown-sizes", _UNSIZED, unsized),
    ]
    return [
        SceneWarning(code=code, message=message, objects=[thing.id for thing in objects])
        for code, message, objects in kinds
        if objects
    ]


def _distant(placed: Sequence[SceneObject], request: SceneRequest) -> list[SceneObject]:
    """Return the objects too far from the viewer, or from the median of a map."""
    positions = [thing.position or _ORIGIN for thing in placed]
    centre = _ORIGIN
    if request.viewpoint is not None:
        centre = (request.viewpoint.x, request.viewpoint.y, 0.0)
    elif placed and is_world_fixed(request.frame_id):
        x, y, z = map(median, zip(*positions, strict=True))
        centre = (x, y, z)
    far = [math.dist(position, centre) > MOST_DISTANT for position in positions]
    return list(compress(placed, far))


def _is_flat(placed: Sequence[SceneObject]) -> bool:
    """Return whether all objects have the same depth, the distance along the optical axis."""
    depths = [thing.position[0] for thing in placed if thing.position is not None]
    return len(depths) >= _LEAST and max(depths) - min(depths) <= _SAME_DEPTH


def _unsized(placed: Sequence[SceneObject], vocabulary: Vocabulary) -> list[SceneObject]:
    classes = vocabulary.objects
    return [
        thing
        for thing in placed
        if thing.size is None
        and (thing.class_index is None or classes[thing.class_index].size is None)
    ]


# ---------------------------------------------------------------- comparison with typical sizes

# An object of known size, its detection, its size and the typical extents of its class in metres.
_Sized = tuple[SceneObject, Detection, Point, Point]

# A piece of furniture, and three misfits. The proportion of a box is its height, divided by the
# geometric mean of the two other sides. A misfit is the absolute log ratio of the proportion to the
# typical proportion, so it does not depend on the unit. The height is the extent along z of the
# scene, along y of the scene, and along the z axis of the box.
_Fit = tuple[SceneObject, float, float, float]


def _sized(
    scene: Scene, detections: Mapping[int, Detection], vocabulary: Vocabulary
) -> list[_Sized]:
    """Return the objects whose size and typical size are known, without thin objects."""
    sized = []
    for number, detection in detections.items():
        thing = scene.objects[number]
        if thing.size is not None and thing.class_index is not None:
            typical = vocabulary.objects[thing.class_index].size
            if typical is not None and min(thing.size) >= SMALLEST:
                sized.append((thing, detection, thing.size, typical))
    return sized


def _scaled(sized: Sequence[_Sized]) -> tuple[float, list[SceneObject]]:
    """Return the common factor of sizes and typical sizes, and its objects if it is implausible."""
    if len(sized) < _LEAST:
        return 1.0, []
    # The mean log ratio of the three sides of each object.
    scales = [math.log(math.prod(size) / math.prod(typical)) / 3 for _, _, size, typical in sized]
    centre = median(scales)
    if abs(centre) < _UNIT:
        return 1.0, []
    agreeing = [
        one[0] for one, scale in zip(sized, scales, strict=True) if abs(scale - centre) <= _TWICE
    ]
    agree = len(agreeing) >= max(_LEAST, _MOST * len(sized))
    return math.exp(centre), agreeing if agree else []


def _fits(sized: Sequence[_Sized]) -> list[_Fit]:
    """Return the fits of the furniture with a position."""
    fits = []
    for thing, detection, (x, y, z), typical in sized:
        own = detection.size
        if own is None or thing.position is None or max(typical) < _FURNITURE:
            continue
        # The yaw decides which side of the box is nearer to the y axis.
        if abs(math.sin(thing.yaw)) > abs(math.cos(thing.yaw)):
            x, y = y, x
        expected = _proportion(typical[2], typical[0], typical[1])
        by_z, by_y = _proportion(z, x, y), _proportion(y, x, z)
        by_own_z = _proportion(own.z, own.x, own.y)
        fits.append((thing, abs(by_z - expected), abs(by_y - expected), abs(by_own_z - expected)))
    return fits


def _proportion(height: float, length: float, width: float) -> float:
    return math.log(height * height / (length * width)) / 2


def _rolled(fits: Sequence[_Fit], detections: Mapping[int, Detection]) -> list[SceneObject]:
    """Return the furniture that lies on its side, although it fits its class upright.

    One object may really have fallen over. So the list is empty, unless it has several objects, or
    all quaternions of the scene are turns about the vertical if w is read first.
    """
    rolled = [thing for thing, by_z, _, by_own_z in fits if by_own_z <= _TWICE <= by_z - by_own_z]
    if not rolled or len(rolled) >= _LEAST:
        return rolled
    turns = [one.orientation for one in detections.values() if one.orientation is not None]
    w_is_first = turns and all(max(abs(turn.y), abs(turn.z)) <= _UPRIGHT for turn in turns)
    return rolled if w_is_first else []


def _y_up(fits: Sequence[_Fit]) -> list[SceneObject]:
    """Return the furniture that fits its class better if y points up, if most furniture does."""
    advantages = [by_z - by_y for _, by_z, by_y, _ in fits]
    total = sum(advantages)
    agree = total >= _MOST * sum(map(abs, advantages))
    if len(advantages) < _LEAST or not agree or total < _BETTER * len(advantages):
        return []
    return [fit[0] for fit, advantage in zip(fits, advantages, strict=True) if advantage > 0]
