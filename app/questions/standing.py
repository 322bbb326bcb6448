"""What holds an object with a box: is the box explained by the usual places of its class?

Let b be the bottom of the box of an object above the floor, with the error s. Each place has a
likelihood of b, per metre (N: normal with the error s, or rarely 3 s; U: 1 / `ROOM`):

    floor       N(b; 0, s)
    on or in j  overlap · [(1 - k) · N(b - top of j; 0, s) + k · U(b between bottom and top of j)]
    on or in an object that the scene does not list   if b is between `_LOWEST` and `_HIGHEST`:
                (U + Σ w_j N(b - bottom of j; 0, s)) / (1 + Σ w_j), because things on one counter
                have one height: w_j is the share S of supports of object j, less if it is far away
                (`_NEAR`); U if a listed object holds this one; `_HIGHER` of it above `_HIGHEST`
    on a wall or at the ceiling   half of U, and half of N(top; `HUNG`, `HUNG_STD`). Things as
                                  high as `_LONG`, such as curtains, often reach the floor
    floating    U
    sunk in     U, if the box reaches below the floor or into an object, unless into a shelf

Things at wrong places are on or in the supporters of any things, or on the floor, but not inside a
container there. This wrong place counts as far as other boxes at the height of the floor show it:
by the sum of their shares S of the floor, at most 1. So no single box shows the floor and lies
wrong on it. k is the share of things far below the top of such an object: on a seat, or on the
boards of a shelf (`Places.within`). The usual places of the class have the shares S of floor, wall
and support, and q of its supporters. An object above a usual supporter is not on an unlisted
object. Objects at wrong places have the shares `WRONG`. The evidence of a wrong place is the log
ratio

    t = log Σ wrong share · likelihood - log Σ usual share · likelihood

So an object is at a wrong place only if no usual place explains its box within the errors. A box
that probably reaches into an object does not float. Nothing floats if the shares of the floor of
the other boxes at its height sum to less than `_TOLD`.

The judgement of a wrong support also asks how likely a relation of the two classes is. It counts
with the probability r that the object is on or in the other one, and not at another usual place.
Structure, such as a listed floor or wall, holds nothing, and things on the wall are on nothing.
"""

import math
from typing import Final, NamedTuple

import numpy as np
from jaxtyping import Float, Int
from numpy.typing import NDArray

from app.compiling import compiled, inlined
from app.scene.footprints import measure
from app.scene.scene import SMALLEST_STD, Boxes, normal_share, overlap_probability

Indices = NDArray[np.int64]
Floats = NDArray[np.float64]

ON_FLOOR, ON_OBJECT, FLOATS, SUNK = range(4)
"""Reasons of a wrong place, which are indices of `WRONG`."""

WRONG: Final = (0.25, 0.4, 0.25, 0.1)
"""Shares of objects at wrong places: on the floor, on or in an object, floating, and sunk in."""

ROOM: Final = 2.5  # height of a room in metres
_LOWEST: Final = 0.2  # lowest top in metres of an unlisted object on which others are
_HIGHEST: Final = 2.0  # height in metres above which the tops of such objects are rarer
_HIGHER: Final = 0.25  # their share of the density there
HUNG: Final = 2.0  # usual height in metres of the top of an object on a wall
HUNG_STD: Final = 0.6  # its standard deviation
_LONG: Final = 1.2  # height in metres from which half of the things on a wall reach the floor
_LONG_STD: Final = 0.1  # standard deviation of their bottoms
_NEAR: Final = (
    0.5  # standard deviation in metres of the distances of objects on one unlisted object
)
_TOLD: Final = 0.5  # minimum sum of shares of the floor by which other boxes show the floor
_USUAL: Final = 0.2  # share q from which a supporter counts fully as usual
_UNLISTED: Final = 0.3  # share of the unlisted supporters that a scene has
_LEAST_WITHIN: Final = 0.1  # minimum of k
_CARRIES: Final = 0.5  # footprint of a supporter, as a share of that on it, that carries fully
_UNUSUAL: Final = 0.02  # weight of an unusual supporter in the choice of the anchor
_LEAST_OVERLAP: Final = 0.05  # probability of an overlap from which an object may hold another
_LARGE, _RARE = 3.0, 0.01  # factor and share of large errors
_LEAST: Final = 1e-6  # minimum of a likelihood
_SQRT_2_PI: Final = math.sqrt(2.0 * math.pi)


def shares_in_scene(supporters: Float[Floats, "R n"]) -> Float[Floats, "R n+1"]:
    """Return the shares of the n listed classes among the supporters in a scene, then of unlisted.

    ``supporters`` are the shares of the listed classes among the supporters of all scenes. An
    unlisted supporter counts with `_UNLISTED` of its share, because the scene hardly has it.
    """
    unlisted = _UNLISTED * np.maximum(1.0 - supporters.sum(1, keepdims=True), 0.0)
    shares = np.concatenate([supporters, unlisted], axis=1)
    return shares / np.maximum(shares.sum(1, keepdims=True), _LEAST)


class Standing(NamedTuple):
    """The evidence that each of N objects is at a wrong place."""

    log_ratio: Float[Floats, "N"]  # t; 0 without a box
    reason: Int[Indices, "N"]  # the likeliest wrong place; -1 without a box or without a reason
    anchor: Int[Indices, "N"]  # the object at the likeliest wrong place, or -1
    held: Float[Floats, "N"]  # r of the object that holds each object most likely


@compiled
def standing(
    boxes: Boxes,
    floor: float,  # height in metres, or NaN: unknown
    shares: Float[NDArray, "N 3"],  # usual places of each object's class: floor, wall, support
    supporters: Float[NDArray, "N+1 N+1"],  # see `shares_in_scene`
    within: Float[NDArray, " N"],  # share k of the things of each object far below its top
    closed: Float[NDArray, " N"],  # whether each object is a container, from 0 to 1
) -> tuple[Float[NDArray, " N"], Int[NDArray, " N"], Int[NDArray, " N"], Float[NDArray, " N"]]:
    """Return the fields of `Standing`."""
    points, extents, _, errors = boxes
    N, uniform = len(points), 1.0 / ROOM
    log_ratio, reason, anchor, held = np.zeros(N), np.full(N, -1), np.full(N, -1), np.zeros(N)
    for i in range(N):
        bottom = points[i, 2] - extents[i, 2] / 2
        if math.isnan(bottom + extents[i, 0] + extents[i, 1]):
            continue
        s = max(errors[i, 1], SMALLEST_STD)
        at_floor, below, unheld, hung = _of_heights(bottom, extents[i, 2], floor, s)
        usual = shares[i, 0] * at_floor + shares[i, 1] * hung
        largest, total, sunk, deepest, near, strange = 0.0, 0.0, below, -1, 0.0, 0.0
        of_anchor, usual_anchor, beside, level, carried = 0.0, 0.0, 0.0, 0.0, 0.0
        told, enclosed, over = 0.0, 0.0, 0.0
        for j in range(N):
            sizes = extents[j, 0] + extents[j, 1] + extents[j, 2]
            if i == j or supporters[N, j] == 0.0 or math.isnan(points[j, 2] + sizes):
                continue
            error = max(math.hypot(s, errors[j, 1]), SMALLEST_STD)
            lift = bottom - points[j, 2] - extents[j, 2] / 2
            if not math.isnan(floor):
                height = points[j, 2] - extents[j, 2] / 2 - floor
                told += shares[j, 0] * math.exp(-0.5 * (height / error) ** 2)
            distance = math.hypot(points[i, 0] - points[j, 0], points[i, 1] - points[j, 1])
            weight = shares[j, 2] * math.exp(-0.5 * (distance / _NEAR) ** 2)
            beside += weight
            level += weight * _normal(lift + extents[j, 2], error)
            overlap = _overlap(boxes, i, j)
            if overlap < _LEAST_OVERLAP:
                continue
            # Only a thick object tells things on it from things beside it.
            thick = 1.0 - math.exp(-0.5 * (extents[j, 2] / error) ** 2)
            inside = normal_share(-lift, error) * normal_share(lift + extents[j, 2], error)
            held_by_it = max(thick * math.exp(-0.5 * (lift / error) ** 2), within[j] * inside)
            carried = max(carried, overlap * held_by_it)
            area = extents[j, 0] * extents[j, 1] / max(extents[i, 0] * extents[i, 1], 1e-9)
            overlap *= min(area / _CARRIES, 1.0)
            k = max(within[j], _LEAST_WITHIN)
            enclosed = max(enclosed, overlap * inside * closed[j])
            uniform_in = inside / max(extents[j, 2], error)
            density = overlap * ((1 - k) * _normal(lift, error) + k * uniform_in)
            usual_at = shares[i, 2] * supporters[i, j] * density
            usual += usual_at
            strange += supporters[N, j] * density
            lifted = normal_share(lift - _LOWEST, error)
            over = max(over, overlap * lifted * min(supporters[i, j] / _USUAL, 1.0))
            total += density
            near += overlap
            likely = density * (supporters[i, j] + _UNUSUAL)
            if likely > largest:
                largest, anchor[i], of_anchor, usual_anchor = likely, j, density, usual_at
            deep = overlap * normal_share(-lift - 2 * error, error) * inside * (1.0 - within[j])
            if deep > sunk:
                sunk, deepest = deep, j
        shared = (1.0 + level / uniform) / (1.0 + beside)
        unheld *= carried + (1.0 - carried) * shared
        usual += shares[i, 2] * supporters[i, N] * (1.0 - over) * unheld
        strange += supporters[N, N] * unheld
        at_floor *= min(told, 1.0) * (1.0 - enclosed)
        wrong = np.array([at_floor, strange, (1.0 - below) * uniform, sunk * uniform])
        for place in range(4):
            wrong[place] *= WRONG[place]
        reason[i] = _reason(wrong, WRONG[ON_OBJECT] * total / max(near, 1.0), sunk, told)
        if reason[i] == SUNK:
            anchor[i] = deepest
        elif reason[i] != ON_OBJECT:
            anchor[i] = -1
        of_anchor *= (1.0 - shares[i, 1]) * WRONG[ON_OBJECT] / max(near, 1.0)
        held[i] = of_anchor / max(of_anchor + usual - usual_anchor, _LEAST)
        log_ratio[i] = math.log(max(wrong.sum(), _LEAST) / max(usual, _LEAST))
    return log_ratio, reason, anchor, held


@inlined
def _of_heights(bottom, height, floor, s):
    """Return likelihoods that need no other object: floor, below it, unlisted object, and wall.

    Without a height of the floor (NaN), the first two are 0.
    """
    uniform = 1.0 / ROOM
    if math.isnan(floor):
        return 0.0, 0.0, uniform, uniform
    b = bottom - floor
    on_wall = uniform * normal_share(b, s) / 2 + _normal(b + height - HUNG, HUNG_STD) / 2
    if height >= _LONG:
        on_wall = (on_wall + _normal(b, max(s, _LONG_STD))) / 2
    higher = _HIGHER + (1.0 - _HIGHER) * normal_share(_HIGHEST - b, s)
    on_unlisted = uniform * normal_share(b - _LOWEST, s) * higher
    return _normal(b, s), normal_share(-2 * s - b, s), on_unlisted, on_wall


@inlined
def _reason(wrong, on_object, sunk, told):
    """Return the likeliest wrong place, or -1 if a box floats over a floor that none shows.

    An object that touches another one does not float, however rare such a supporter is, so the
    likelihood on an object is that of any supporter.
    """
    reason, largest = ON_FLOOR, wrong[ON_FLOOR]
    for place in (ON_OBJECT, FLOATS, SUNK):
        likelihood = on_object if place == ON_OBJECT else wrong[place]
        if likelihood > largest:
            reason, largest = place, likelihood
    if reason == FLOATS and sunk > 0.5:
        return SUNK
    return -1 if reason == FLOATS and told < _TOLD else reason


@compiled
def _normal(distance, s):
    """Return the density per metre of a distance with the error s, rarely `_LARGE` times as large.

    Detectors make large errors more often than a normal distribution does.
    """
    narrow = math.exp(-0.5 * (distance / s) ** 2)
    wide = math.exp(-0.5 * (distance / (_LARGE * s)) ** 2) / _LARGE
    return ((1.0 - _RARE) * narrow + _RARE * wide) / (s * _SQRT_2_PI)


@compiled
def _overlap(boxes, i, j):
    """Return the probability that the footprints of two boxes overlap by `MIN_OVERLAP`."""
    points, extents, turns, _ = boxes
    radius = math.hypot(extents[i, 0], extents[i, 1]) + math.hypot(extents[j, 0], extents[j, 1])
    distance = math.hypot(points[i, 0] - points[j, 0], points[i, 1] - points[j, 1])
    if distance > radius / 2:
        return 0.0
    share, gap = measure(points[i], extents[i], turns[i], points[j], extents[j], turns[j])
    smaller = min(extents[i, 0] * extents[i, 1], extents[j, 0] * extents[j, 1])
    return overlap_probability(boxes, i, j, share - gap / math.sqrt(max(smaller, 1e-9)))
