"""What is probably a mistake in a scene: told with the answer, which is given all the same."""

from __future__ import annotations

import math
from collections.abc import Sequence
from statistics import median
from typing import Final, Literal

from app.scene.frames import is_optical, is_world_fixed
from app.scene.scene import Point, Scene, SceneObject
from app.scene.vocabulary import Vocabulary
from scene_client.schemas import SceneRequest, SceneWarning

MOST_DISTANT: Final = 100.0  # m: millimetres taken for metres are a thousand times as far
SMALLEST, LARGEST = 1e-3, 20.0  # m, sides of a box
_SAME_DEPTH: Final = 1e-3  # m
_LEAST_FLAT: Final = 3  # objects; two may stand side by side

Code = Literal["implausible-position", "implausible-size", "flat-scene", "unknown-sizes"]


def scene_warnings(
    given: Scene, scene: Scene, vocabulary: Vocabulary, request: SceneRequest
) -> list[SceneWarning]:
    """The warnings of a scene, in a fixed order.

    Args:
        given: in body axes of the request's frame.
        scene: the same after `observe`: seen from the viewpoint, if there is one.
    """
    found: list[SceneWarning] = []
    sized = [thing for thing in scene.objects if thing.size is not None]
    # Plain comparisons: most scenes have no poses, and all others pass them.
    placed = [thing for thing in scene.objects if thing.position is not None]
    if placed:
        _add(
            found,
            "implausible-position",
            f"more than {MOST_DISTANT:g} m away: positions are metres, not millimetres",
            _distant(given, request),
        )
    if sized:
        _add(
            found,
            "implausible-size",
            f"a side below {SMALLEST * 1e3:g} mm or above {LARGEST:g} m: sizes are metres",
            [thing for thing in sized if not _is_plausible(thing.size)],
        )
    if request.frame_id is not None and is_optical(request.frame_id) and _is_flat(given):
        _add(
            found,
            "flat-scene",
            "all positions have one depth along the optical axis: is the depth missing?",
            placed,
        )
    if scene.poses is not None and len(placed) > 1:
        _add(
            found,
            "unknown-sizes",
            "vertical relations are unobserved: no size is given, and none is typical of the class",
            _unsized(placed, vocabulary),
        )
    return found


def _add(
    found: list[SceneWarning], code: Code, message: str, objects: Sequence[SceneObject]
) -> None:
    if objects:
        ids = [thing.id for thing in objects]
        found.append(SceneWarning(code=code, message=message, objects=ids))


def _distant(given: Scene, request: SceneRequest) -> list[SceneObject]:
    """Objects far from the viewer or, where its place in the world is unknown, from the others."""
    placed = [(thing, thing.position) for thing in given.objects if thing.position is not None]
    centre: Point = (0.0, 0.0, 0.0)
    if request.viewpoint is not None:
        centre = (request.viewpoint.x, request.viewpoint.y, 0.0)
    elif request.frame_id is not None and is_world_fixed(request.frame_id):
        xs, ys, zs = zip(*[position for _, position in placed], strict=True)
        centre = (median(xs), median(ys), median(zs))
    return [thing for thing, place in placed if math.dist(place, centre) > MOST_DISTANT]


def _is_plausible(size: Point | None) -> bool:
    return size is None or (min(size) >= SMALLEST and max(size) <= LARGEST)


def _is_flat(given: Scene) -> bool:
    """Whether all have the same depth along the optical axis, which is x in body axes."""
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
