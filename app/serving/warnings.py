"""Warnings about probable mistakes in a scene. Answers contain these warnings."""

from __future__ import annotations

import math
from collections.abc import Sequence
from statistics import median
from typing import Final, Literal

from app.scene.frames import is_optical, is_world_fixed
from app.scene.geometry import LARGEST, MOST_DISTANT, SMALLEST
from app.scene.scene import Point, Scene, SceneObject
from app.scene.vocabulary import Vocabulary
from scene_client.schemas import SceneRequest, SceneWarning

_SAME_DEPTH: Final = 1e-3  # maximum difference in m of depths that count as equal
_LEAST_FLAT: Final = 3  # minimum number of objects for the warning flat-scene

_TOO_FAR: Final = (
    f"the object is more than {MOST_DISTANT:g} m from the viewer; positions must be in metres"
)
_ODD_SIZE: Final = (
    f"all sides of the object are below {SMALLEST * 1e3:g} mm, so its size is unknown, or a side "
    f"is above {LARGEST:g} m; sizes must be in metres"
)
_FLAT: Final = "all objects have the same depth along the optical axis; the depth may be missing"
_UNSIZED: Final = (
    "the service cannot derive vertical relations of this object: the object has no size, and its "
    "class has no typical size"
)

Code = Literal["implausible-position", "implausible-size", "flat-scene", "unknown-sizes"]


def scene_warnings(
    given: Scene, scene: Scene, vocabulary: Vocabulary, request: SceneRequest
) -> list[SceneWarning]:
    """Return the warnings about a scene.

    Args:
        given: the scene in the request's frame, in axes of REP-103 (x forward, y left, z up).
        scene: the same scene after `observe`, in the axes of the viewer if the request has a
            viewpoint.
        vocabulary: classes of the model, with their typical sizes.
        request: the request that contains the scene.
    """
    # Python loops are fast enough, because most scenes have no poses or pass all checks.
    placed = [thing for thing in scene.objects if thing.position is not None]
    odd = [thing for thing in scene.objects if not _is_plausible(thing.size)]
    is_seen_flat = request.frame_id is not None and is_optical(request.frame_id) and _is_flat(given)
    has_poses = scene.poses is not None and len(placed) > 1
    found: list[tuple[Code, str, Sequence[SceneObject]]] = [
        ("implausible-position", _TOO_FAR, _distant(given, request) if placed else ()),
        ("implausible-size", _ODD_SIZE, odd),
        ("flat-scene", _FLAT, placed if is_seen_flat else ()),
        ("unknown-sizes", _UNSIZED, _unsized(placed, vocabulary) if has_poses else ()),
    ]
    return [
        SceneWarning(code=code, message=message, objects=[thing.id for thing in objects])
        for code, message, objects in found
        if objects
    ]


def _distant(given: Scene, request: SceneRequest) -> list[SceneObject]:
    """Return the objects that are too far from the viewer.

    In a world-fixed frame without a viewpoint, the position of the viewer is unknown. The median
    position of the objects then replaces the position of the viewer.
    """
    placed = [(thing, thing.position) for thing in given.objects if thing.position is not None]
    centre: Point = (0.0, 0.0, 0.0)
    if request.viewpoint is not None:
        centre = (request.viewpoint.x, request.viewpoint.y, 0.0)
    elif request.frame_id is not None and is_world_fixed(request.frame_id):
        xs, ys, zs = zip(*[position for _, position in placed], strict=True)
        centre = (median(xs), median(ys), median(zs))
    return [thing for thing, place in placed if math.dist(place, centre) > MOST_DISTANT]


def _is_plausible(size: Point | None) -> bool:
    return size is None or SMALLEST <= max(size) <= LARGEST


def _is_flat(given: Scene) -> bool:
    """Return whether all objects have the same depth, the distance along the optical axis."""
    depths = [thing.position[0] for thing in given.objects if thing.position is not None]
    return len(depths) >= _LEAST_FLAT and max(depths) - min(depths) <= _SAME_DEPTH


def _unsized(placed: Sequence[SceneObject], vocabulary: Vocabulary) -> list[SceneObject]:
    sizes = vocabulary.sizes
    return [
        thing
        for thing in placed
        if thing.size is None
        and (thing.class_index is None or math.isnan(sizes[thing.class_index, 0]))
    ]
