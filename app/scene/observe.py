"""Derive the relations of a scene from its poses."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from app.scene.frames import is_world_fixed
from app.scene.geometry import SMALLEST, Viewpoint, derive_relations, to_viewer_frame
from app.scene.scene import Scene, SceneObject

_UNKNOWN = (math.nan, math.nan, math.nan)


def observe(
    scene: Scene,
    *,
    frame_id: str | None = None,
    viewpoint: Viewpoint | None = None,
    typical_sizes: NDArray[np.float64] | None = None,
) -> Scene:
    """Derive the relations of a scene from the poses of its objects.

    Positions and yaws must be in body axes (`app.scene.frames.body_pose`). If ``viewpoint`` is
    given, the returned scene has positions and yaws in viewer axes. The field ``relations`` of the
    result lists the relations that hold. The field ``poses`` also contains relations observed not
    to hold.

    The function returns a scene unchanged if the scene states relations or has no positions. In a
    world-fixed frame (map, odom, world) without a viewpoint, left and front are undefined. The
    function then derives only on-top and above.

    Args:
        scene: the scene.
        frame_id: name of the frame of the positions.
        viewpoint: position and heading of the viewer in this frame. By default, the viewer is at
            the origin and looks along x.
        typical_sizes: (V, 3) typical extents of each class in metres (`Vocabulary.sizes`). They
            replace missing sizes of objects, and sizes below `SMALLEST`. NaN means an unknown size.
    """
    if scene.relations is not None or all(thing.position is None for thing in scene.objects):
        return scene
    if viewpoint is not None:
        scene = replace(scene, objects=_seen_from(scene.objects, viewpoint))
    positions = np.array([thing.position or _UNKNOWN for thing in scene.objects])
    sizes = np.array([_extent(thing, typical_sizes) for thing in scene.objects])
    yaws = np.array([thing.yaw for thing in scene.objects])
    nobody_looks = viewpoint is None and frame_id is not None and is_world_fixed(frame_id)
    poses = derive_relations(positions, sizes, yaws, horizontal=not nobody_looks)
    triples = tuple(zip(*(ends.tolist() for ends in np.nonzero(poses.holds)), strict=True))
    return replace(scene, relations=triples, poses=poses)


def _seen_from(objects: tuple[SceneObject, ...], viewpoint: Viewpoint) -> tuple[SceneObject, ...]:
    positions, yaws = to_viewer_frame(
        [thing.position or _UNKNOWN for thing in objects],
        viewpoint,
        [thing.yaw for thing in objects],
    )
    turned = [
        thing
        if thing.position is None
        else SceneObject(
            thing.id, thing.label, thing.class_index, thing.confidence, (x, y, z), thing.size, yaw
        )
        for thing, (x, y, z), yaw in zip(objects, positions.tolist(), yaws.tolist(), strict=True)
    ]
    return tuple(turned)


def _extent(thing: SceneObject, typical_sizes: NDArray[np.float64] | None) -> Sequence[float]:
    if thing.size is not None and max(thing.size) >= SMALLEST:
        return thing.size
    if typical_sizes is not None and thing.class_index is not None:
        size: list[float] = typical_sizes[thing.class_index].tolist()
        return size
    return _UNKNOWN
