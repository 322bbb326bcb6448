"""The conventions that the boxes of a scene probably follow, if these are not the declared ones.

A reading of a scene has other conventions than the declared ones in one respect. The likelihood of
its boxes (`app.scene.box_fit`) and its prior decide between the readings. One warning names the
likeliest reading, and the fields that declare it.
"""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import lru_cache
from typing import Final, get_args

import numpy as np
from jaxtyping import Float
from numpy.typing import NDArray

from app.scene.box_fit import Boxes, Readings, any_tilted, log_likelihoods
from app.scene.scene import SceneObject
from app.scene.vocabulary import Vocabulary
from scene_client.frames import (
    METRES,
    BoxOrigin,
    Conventions,
    Quaternion,
    QuaternionOrder,
    Vector,
    optical_name,
    to_body,
    to_frame,
    viewer_axes,
)

LEAST: Final = 3
"""Minimum number of boxes, and of those that decide, whose size and typical size are known."""

MOST: Final = 32
"""Maximum number of boxes of a scene that decide: the first ones."""

SPREAD: Final = 0.35
"""Standard deviation of the logarithm of the sides of objects of a class."""

_STANDS: Final = (0.4, 0.2, 0.4)  # shares of the stands of a class without known places
_PRIOR: Final = -5.0  # log odds of a mistake before its evidence
_RARE: Final = -7.0  # of a mistake that fewer users make
_NOT_A_UNIT: Final = math.log(2.5)  # least log factor of sizes that no unit explains
_UNKNOWN: Final = (math.nan, math.nan, math.nan)
_UPS: Final = ("z", "y", "-y")
_OTHER_ORDER: Final[dict[str, QuaternionOrder]] = {"xyzw": "wxyz", "wxyz": "xyzw"}


@dataclass(frozen=True)
class Alternative:
    """A reading of a scene. The fields after `log_prior` are those of `Readings`.

    `declare` has the fields of a scene that declare the reading. It is empty if no field does.
    """

    message: str
    declare: Mapping[str, str] = field(default_factory=dict)
    log_prior: float = _PRIOR
    axis: tuple[int, ...] = (0, 1, 2)
    sign: tuple[float, ...] = (1.0, 1.0, 1.0)
    side: tuple[int, ...] = (0, 1, 2)
    size: float = 1.0
    place: float = 1.0
    scale: float = 1.0
    shift: Vector = (0.0, 0.0, 0.0)
    up: int = 0


@dataclass(frozen=True)
class Evidence:
    """Log-odds of the readings of a scene, `alternatives`, against the declared one."""

    alternatives: tuple[Alternative, ...]
    log_odds: Float[NDArray[np.float64], "R"]  # without the priors
    factor: float  # that makes the sizes typical

    @property
    def likeliest(self) -> Alternative | None:
        """The likeliest reading, or None for the declared one."""
        if self.log_odds.max() <= -_PRIOR:  # the usual case, and the fastest
            return None
        total = self.log_odds + np.array([one.log_prior for one in self.alternatives])
        if abs(math.log(self.factor)) < _NOT_A_UNIT:
            total[[one.scale != one.scale for one in self.alternatives]] = -np.inf
        best = self.alternatives[int(total.argmax())]
        if not best.message or total.max() <= 0:
            return None
        return replace(best, message=best.message.format(times=f"{1 / self.factor:.2g}"))


def evidence_of(
    objects: Sequence[SceneObject],  # in body axes and metres
    turns: Mapping[int, Quaternion],  # as in the request, by the index of the object
    declared: Conventions,
    vocabulary: Vocabulary,
    stands: Float[NDArray[np.floating], "V 3"] | None,  # `Places.stands`
    reread: Callable[[Conventions], Sequence[SceneObject]],  # the objects under other conventions
) -> Evidence | None:
    """Compare the readings of a scene, or return None if too few sizes are known."""
    rows = [
        row
        for row, thing in enumerate(objects)
        if thing.size is not None
        and max(thing.size) > 0.0
        and thing.class_index is not None
        and vocabulary.objects[thing.class_index].size is not None
        and not vocabulary.objects[thing.class_index].structure
    ][:MOST]
    if len(rows) < LEAST:
        return None
    things, found = [objects[row] for row in rows], alternatives(declared)
    indices = [thing.class_index for thing in things if thing.class_index is not None]
    classes = vocabulary.stand_in[indices]
    usual = np.full((len(rows), 3), _STANDS) if stands is None else stands[classes].astype(float)
    q = [turns.get(row) for row in rows]
    boxes = Boxes(
        centre=np.array([thing.position or _UNKNOWN for thing in things]),
        size=np.array([thing.size for thing in things], np.float64),
        yaw=np.array([thing.yaw for thing in things]),
        turn=_in_order(q, declared),
        typical=vocabulary.sizes[classes],
        spread=np.full(len(rows), SPREAD),
        stands=usual,
    )
    log_p, factor = log_likelihoods(boxes, readings_of(declared))
    if any(q) and any_tilted(boxes.turn, _UPS.index(declared.up)):
        other = declared._replace(quaternion_order=_OTHER_ORDER[declared.quaternion_order])
        again = reread(other)
        reordered = boxes._replace(
            centre=np.array([again[row].position or _UNKNOWN for row in rows]),
            size=np.array([again[row].size for row in rows], np.float64),
            yaw=np.array([again[row].yaw for row in rows]),
            turn=_in_order(q, other),
        )
        of_order, _ = log_likelihoods(reordered, readings_of(declared))
        log_p, found = np.append(log_p, of_order[0]), (*found, _of_order(other))
    return Evidence(found, log_p - log_p[0], factor)


def warm_up(vocabulary: Vocabulary, stands: Float[NDArray[np.floating], "V 3"] | None) -> None:
    """Compare the readings of three boxes, so that numba compiles or loads every loop."""
    sized = (k for k, entry in enumerate(vocabulary.objects) if entry.size and not entry.structure)
    if (index := next(sized, None)) is not None:
        size = vocabulary.objects[index].size
        objects = [SceneObject("", "", index, position=(0.0, 0.0, 0.0), size=size)] * LEAST
        overturned = {0: (1.0, 0.0, 0.0, 0.0)}
        evidence_of(objects, overturned, Conventions(), vocabulary, stands, lambda _: objects)


def _in_order(q: Sequence[Quaternion | None], conventions: Conventions) -> NDArray[np.float64]:
    """Return quaternions in the order x, y, z, w, and NaN for objects without one."""
    if not any(q):
        return np.full((len(q), 4), math.nan)
    turn = np.array([(math.nan,) * 4 if one is None else one for one in q])
    return turn if conventions.quaternion_order == "xyzw" else np.roll(turn, -1, axis=1)


# -------------------------------------------------------------------------------- the readings


@lru_cache(maxsize=256)
def alternatives(declared: Conventions) -> tuple[Alternative, ...]:
    """Return the readings of a scene without quaternions. The first one is the declared one."""
    same = Alternative(
        "", log_prior=0.0, shift=_shift(declared.up, declared.box_origin),
        up=_UPS.index(declared.up),
    )  # fmt: skip
    return (
        same,
        *(_of_axes(up, declared) for up in _UPS if up != declared.up),
        _of_sides(declared, same),
        *(_of_unit(unit, declared, same) for unit in METRES if unit != declared.units),
        replace(same, message=_SCALED, log_prior=_RARE, scale=math.nan),
        *_of_extents(declared, same),
        *(
            _of_places(unit, declared, same)
            for unit, metres in METRES.items()
            if metres < METRES[declared.units]
        ),
        *(
            _of_origin(point, declared, same)
            for point in get_args(BoxOrigin)
            if point != declared.box_origin
        ),
    )


@lru_cache(maxsize=256)
def readings_of(declared: Conventions) -> Readings:
    """Return the `alternatives` as arrays."""
    rows = alternatives(declared)
    return Readings(*(np.array([getattr(row, name) for row in rows]) for name in Readings._fields))


_BETTER: Final = "the sizes and heights of the boxes fit their classes better "
_SCALED: Final = (
    "the sizes are about {times} times the typical sizes of their classes; send lengths in `units`"
)
_DOUBLE: Final = (
    _BETTER + "if each side is half as long; sizes must be those of the whole box, once"
)
_SIDES: Final = (
    _BETTER + "with the sides in another order; a size has the sides along the axes of the frame, "
    "before the rotation by `orientation`"
)


def _shift(up: str, origin: BoxOrigin) -> Vector:
    """Return the way from the origin of an unrotated box to its centre, in halves of its sides."""
    if origin == "centre":
        return 0.0, 0.0, 0.0
    return (0.0, 0.0, 1.0) if origin == "bottom" else to_body((1.0, 1.0, 1.0), up)


def _of_axes(up: str, declared: Conventions) -> Alternative:
    """Return the reading with another axis that points up."""
    matrix = np.array([to_body(to_frame(one, declared.up), up) for one in viewer_axes()]).T
    axis = np.abs(matrix).argmax(1)
    declare = {"up": up}
    message = f"if the {up} axis of the frame points up: declare `up` as {up}"
    if up == "-y":
        declare = {"frame_id": "optical"}
        message = (
            "if the axes are those of a camera (x right, y down, z ahead): send a `frame_id` that "
            "ends in _optical, without `up`"
        )
    elif declared.up == "-y":
        declare |= {"frame_id": "body"}
        message += ", and send a `frame_id` that does not end in _optical"
    return Alternative(
        _BETTER + message, declare, axis=tuple(axis.tolist()), side=tuple(axis.tolist()),
        sign=tuple(matrix[np.arange(3), axis].tolist()), shift=_shift(up, declared.box_origin),
        up=_UPS.index(up),
    )  # fmt: skip


def _of_sides(declared: Conventions, same: Alternative) -> Alternative:
    """Return the reading with sizes along other axes than the positions."""
    side = (0, 2, 1) if declared.up == "z" else (1, 2, 0)
    return replace(same, message=_SIDES, log_prior=_RARE, side=side)


def _of_unit(unit: str, declared: Conventions, same: Alternative) -> Alternative:
    """Return the reading with another unit."""
    message = f"{_BETTER}in {unit}: declare `units` as {unit}"
    scale = METRES[unit] / METRES[declared.units]
    return replace(same, message=message, declare={"units": unit}, scale=scale)


def _of_places(unit: str, declared: Conventions, same: Alternative) -> Alternative:
    """Return the reading with positions in a smaller unit."""
    place = METRES[unit] / METRES[declared.units]
    message = f"{_BETTER}if positions alone are in {unit}; send all lengths in `units`"
    return replace(same, message=message, log_prior=_RARE, place=place)


def _of_extents(declared: Conventions, same: Alternative) -> tuple[Alternative, Alternative]:
    """Return the readings with sizes twice and half as large."""
    half = f"{_BETTER}if a size has half of each side: declare `extents` as half"
    full = f"{_BETTER}if a size has the whole sides: declare `extents` as full"
    # A wrong label or an overlap is evidence for other sizes too, so these need more evidence.
    larger, smaller = (replace(same, log_prior=_RARE, size=factor) for factor in (2.0, 0.5))
    if declared.extents == "full":
        larger = replace(larger, message=half, declare={"extents": "half"})
        return larger, replace(smaller, message=_DOUBLE)
    larger = replace(larger, message=_SCALED)
    return larger, replace(smaller, message=full, declare={"extents": "full"})


def _of_origin(point: BoxOrigin, declared: Conventions, same: Alternative) -> Alternative:
    """Return the reading with another origin of boxes."""
    where = {"centre": "centre", "bottom": "middle of the bottom", "corner": "lowest corner"}
    message = f"{_BETTER}if positions are the {where[point]}: declare `box_origin` as {point}"
    prior = _PRIOR if point != "corner" else _PRIOR - 1.0
    shift = _shift(declared.up, point)
    return replace(
        same, message=message, declare={"box_origin": point}, log_prior=prior, shift=shift
    )


def _of_order(other: Conventions) -> Alternative:
    """Return the reading with the other order of quaternions."""
    order = other.quaternion_order
    message = f"{_BETTER}if quaternions are {order}: declare `quaternion_order` as {order}"
    return Alternative(message, {"quaternion_order": order})


def fields_to_declare(reading: Alternative, frame_id: str | None) -> dict[str, str]:
    """Return the fields that declare a reading in place of those of a request."""
    fields = dict(reading.declare)
    if "frame_id" in fields:
        fields["frame_id"] = optical_name(frame_id, optical=fields["frame_id"] == "optical")
    return fields
