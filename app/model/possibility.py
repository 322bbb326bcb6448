"""The prior of possibility: can an object of one class be on, under, above or in one of another?

A table does not stand on a cup, a cat is not in an oven, and a shelf holds more than a screen. The
sizes and the usual places of things show this, also for two classes that no scene shows together.
`training.fit.possibility` fits the weights to stated supports and to boxes.
"""

import math
from dataclasses import dataclass
from functools import cached_property
from typing import Annotated, ClassVar, Final

import numpy as np
from jaxtyping import Bool, Float, Int
from numpy.typing import NDArray

from app.compiling import compiled, inlined
from app.inference import Weights
from app.inference.relation_units import Means, Moments, Pairs, RelationUnits
from app.model.fields import TensorGroup
from app.model.statistics import Places
from app.scene.roles import find_row
from app.scene.spatial_relations import ABOVE, ON_TOP

Table = NDArray[np.float32]
Floats = NDArray[np.float64]
Indices = NDArray[np.int64]

AT_FLOOR, AT_WALL, AT_CEILING, AT_SURFACE, AT_INSIDE = range(5)
"""Columns of `Possibility.stands`: where things stand."""

SURFACE, CONTAINER, CARRIED = range(3)
"""Columns of `Possibility.traits`.

The first two have 0 for no, .5 for sometimes and 1 for yes. The third one has 0 for one hand, 1 for
two hands, 2 for several people and 3 for nobody.
"""

UNKNOWN: Final = -1.0  # surface of a class without a description

ON, UNDER, OVER, IN = range(4)
"""Rows of `Possibility.weights`: on another object, under, above and in it."""

FEATURES: Final = 4
_FLAT: Final = 0.1  # maximum height in metres of a thing on which objects of the floor stand
_LEAST_SHARE: Final = 0.01  # minimum share of a place
_SCENES: Final = 2.0  # number of scenes with a relation that weigh as much as the prior
PRIOR_SHARE: Final = 0.25
"""Share of the prior in the logits of a relation that no scene shows; chosen by log-loss."""
_SAID: Final = -2.3  # log of the share of "under" among the statements of on-top and under

# Columns of the rows of things in the loops: logs of the shares of surface, inside, wall or
# ceiling, and floor; surface, container and carried; log area, three log sides, and height.
_FLOOR_LOG, _SURFACE, _CARRY, _AREA, _SIDES, _HEIGHT, _COLUMNS = 3, 4, 6, 7, 8, 11, 12


@dataclass(frozen=True, eq=False)
class Possibility(TensorGroup):
    """Descriptions of V classes, and the weights of the prior.

    The log prior of a place a (`ON`, `UNDER`, `OVER`, `IN`) of class i at class j is

        c_a(i, j) = -Σ_f w_af φ_f(i, j), with w_af ≥ 0

    up to a constant of the place, with four features φ:

        -log share of class i at such a place: on a surface (or on the floor, if class j is flat),
        on the floor (under), on a wall or ceiling (above), or inside
        1 - surface of class j (on, under), or 1 - container of class j (in)
        how much larger i is: log ratio of the footprints, and under, of the heights; in: sum of the
        log ratios of the three sides in order of size. Negative ratios count as 0
        how much harder i is to carry, at least 0
    """

    prefix: ClassVar[str] = "possibility."
    integers = ()

    stands: Annotated[Table, "V", 5]  # shares of floor, wall, ceiling, surface and inside
    traits: Annotated[Table, "V", 3]
    spread: Annotated[Table, "V"]  # standard deviation of the log of the sizes of the class
    weights: Annotated[Table, 4, FEATURES]  # w_af

    def check(self, A: int, V: int, C: int) -> None:
        """Check the values for a model with V classes."""
        self.require((self.stands >= 0).all(), "shares must be at least 0")
        self.require((self.spread > 0).all(), "spreads must be positive")
        is_right = (self.weights >= 0).all() and (self.traits >= UNKNOWN).all()
        self.require(is_right, "weights must be at least 0, and traits at least -1")

    def rows(
        self, classes: Int[Indices, "N"], sizes: Float[Floats, "N 3"]
    ) -> Float[Floats, "N columns"]:
        """Return rows for `log_p`, of N things with sizes in metres or NaN."""
        stands, rows = self.stands[classes], np.empty((len(classes), _COLUMNS))
        places = stands[:, AT_SURFACE], stands[:, AT_INSIDE], stands[:, AT_WALL:AT_SURFACE].sum(1)
        shares = np.column_stack([*places, stands[:, AT_FLOOR]])
        rows[:, : len(shares.T)] = np.log(np.maximum(shares, _LEAST_SHARE))
        rows[:, _SURFACE:_AREA] = self.traits[classes]
        rows[:, _SIDES:_HEIGHT] = np.log(np.maximum(np.sort(sizes, axis=1), 1e-3))
        rows[:, _AREA] = np.log(np.maximum(sizes[:, 0] * sizes[:, 1], 1e-6))
        rows[:, _HEIGHT] = sizes[:, 2]
        return rows

    def log_p(
        self, things: Float[Floats, "N columns"], others: Float[Floats, "m columns"]
    ) -> Float[Floats, "4 N m"]:
        """Return c_a of each place a of N things at m other things, 0 without a description."""
        return _log_p(self._weights, things, others)

    @property
    def is_described(self) -> Bool[NDArray[np.bool_], "V"]:
        """Whether each class has a description."""
        return self.traits[:, SURFACE] != UNKNOWN

    @property
    def holders(self) -> Float[Table, "V 3"]:
        """Shares of the floor, of a wall or the ceiling, and of other objects; see `Places`."""
        parts = slice(AT_WALL), slice(AT_WALL, AT_SURFACE), slice(AT_SURFACE, None)
        return np.stack([self.stands[:, part].sum(1) for part in parts], axis=1)

    @cached_property
    def _weights(self) -> Floats:
        return self.weights.astype(np.float64)


@compiled
def features(
    place: int, things: Float[NDArray, "N columns"], others: Float[NDArray, "N columns"]
) -> Float[NDArray, "N 4"]:
    """Return the features φ of a place of N things, each at its other thing."""
    table = np.empty((len(things), FEATURES))
    for k in range(len(things)):
        table[k] = _features(place, things[k], others[k])
    return table


@inlined
def _features(place, thing, other):
    """Return the four features φ of a place of a thing at another thing."""
    misfit, role = max(thing[_AREA] - other[_AREA], 0.0), 0.0
    if place == ON:
        share, role = thing[0], 1.0 - other[4]
        if other[_HEIGHT] < _FLAT:
            share = max(share, thing[_FLOOR_LOG])
    elif place == UNDER:
        share, role = thing[_FLOOR_LOG], 1.0 - other[4]
        misfit += max(math.log(max(thing[_HEIGHT], 1e-3) / max(other[_HEIGHT], 1e-3)), 0.0)
    elif place == OVER:
        share = thing[2]
    else:
        share, role, misfit = thing[1], 1.0 - other[5], 0.0
        for side in range(_SIDES, _HEIGHT):
            misfit += max(thing[side] - other[side], 0.0)
    if math.isnan(misfit):
        misfit = 0.0
    return -share, role, misfit, max(thing[_CARRY] - other[_CARRY], 0.0)


@compiled
def _log_p(
    weights: Float[NDArray, "4 features"],
    things: Float[NDArray, "N columns"],
    others: Float[NDArray, "m columns"],
) -> Float[NDArray, "4 N m"]:
    """Return the log priors of all places of N things at m others, 0 without a description."""
    c = np.zeros((4, len(things), len(others)))
    for place in range(4):
        for i in range(len(things)):
            for j in range(len(others)):
                c[place, i, j] = _log_prior(weights, place, things[i], others[j])
    return c


@inlined
def _log_prior(weights, place, thing, other):
    """Return c of a place of a thing at another thing, 0 without a description."""
    if thing[_SURFACE] < 0 or other[_SURFACE] < 0:
        return 0.0
    share, role, misfit, heavy = _features(place, thing, other)
    w = weights[place]
    return -(w[0] * share + w[1] * role + w[2] * misfit + w[3] * heavy)


def known_share(scenes: Float[NDArray[np.floating], "..."]) -> Float[NDArray[np.floating], "..."]:
    """Return k = n / (n + 2) for relations that n training scenes show: 1 for inf."""
    return 1.0 - _SCENES / (scenes + _SCENES)


class UnitsWithPrior(RelationUnits):
    """Relation units of a machine, whose logits of stacked relations have the prior added.

    A relation of two classes that n training scenes show has the logit ℓ + (1 - k) c / 4. "The desk
    is on top of the bin" may mean that the bin is under the desk, so on-top has the sum of both
    priors.
    """

    def __init__(
        self,
        weights: Weights,
        units: RelationUnits,
        rows: Float[Floats, "V columns"],  # of all classes; see `Possibility.rows`
        prior: Possibility,
        places: Places,
    ) -> None:
        super().__init__(weights)
        self._units, self._rows, self._weights = units, rows, prior.weights.astype(np.float64)
        self._scenes = places.triple, places.triple_scenes

    def moments(
        self, means: Means, pairs: Pairs, chosen: slice, *, sampled: bool = False
    ) -> Moments:
        """Return means with the prior, and √3 σ of the logits."""
        mean, spread = self._units.moments(means, pairs, chosen, sampled=sampled)
        _add_prior(
            self._weights, self._rows, *self._scenes, pairs.classes, pairs.i, pairs.j,
            chosen.start or 0, mean,
        )  # fmt: skip
        return mean, spread

    def implication_weights(
        self, x: Float[NDArray, " H1"], beta: float = 1.0
    ) -> Float[NDArray, "F A"] | None:
        """Return the weights of the machine."""
        return self._units.implication_weights(x, beta)


@compiled
def _add_prior(
    weights: Float[NDArray, "4 features"],
    rows: Float[NDArray, "V columns"],
    triple: Int[NDArray, " R"],
    triple_scenes: Float[NDArray, " R"],
    classes: Int[NDArray, " n"],
    i: Int[NDArray, "B P"],  # positions of the subjects in `classes`
    j: Int[NDArray, "B P"],
    first: int,  # relation of the first row of `mean`
    mean: Float[NDArray, "B R P"],
) -> None:
    """Add the prior to logits of pairs, in place."""
    V = len(rows)
    for b in range(mean.shape[0]):
        for p in range(mean.shape[2]):
            x, y = classes[i[b, p]], classes[j[b, p]]
            for row in range(max(ON_TOP - first, 0), mean.shape[1]):
                a = first + row
                if a == ON_TOP:
                    on = _log_prior(weights, ON, rows[x], rows[y])
                    under = _SAID + _log_prior(weights, UNDER, rows[y], rows[x])
                    larger = max(on, under)  # subtracted, because exp may be 0
                    c = larger + math.log(math.exp(on - larger) + math.exp(under - larger))
                    c = min(c, 0.0)
                else:
                    c = _log_prior(weights, OVER if a == ABOVE else IN, rows[x], rows[y])
                found = find_row(triple, (a * V + x) * V + y)
                n = triple_scenes[found] if found >= 0 else 0.0
                mean[b, row, p] += PRIOR_SHARE * c * _SCENES / (n + _SCENES)
