"""Counts of where objects of each class stand in the training scenes.

The counts serve two purposes. The roles decide between on, under and in for boxes that reach into
each other (`app.scene.roles`). The triples tell which classes stand at a place, such as on a desk:

    p(i at a, j) = (N(a, i, j) + s · p(i at a)) / (N(a, any class, j) + s)
    p(i at a)    = (N(a, i, any class) + m · p(i)) / (N(a, any class, any class) + m)

N is the number of scenes with a relation a from class i to class j, or in the other direction.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Annotated, Any, ClassVar, Final

import numpy as np
from jaxtyping import Bool, Float, Int, UInt8
from numpy.typing import NDArray

from app.compiling import compiled
from app.model.fields import TensorGroup
from app.scene.roles import IN, ON, UNDER, RoleCounts, find_row, role_counts
from app.scene.spatial_relations import CANONICAL, ON_TOP, STACKED, SUPPORTS
from app.scene.stands import HANGS, SUPPORTED, USUAL

_PLACE: Final = 10.0  # smoothing s, in scenes
_RELATION: Final = 3.0  # smoothing m, in scenes
_SUPPORTER: Final = 10.0  # smoothing of the supporters of a class, in scenes
_SEEN: Final = 0.5  # smoothing of the counts of supporters
_OTHER_ROLES: Final = 0.5  # smoothing of the counts of other roles
_LEAST_STAND: Final = 0.005  # minimum share of a stand
_SHOWN: Final = 2.0  # minimum number of scenes that show a relation

Floats = NDArray[np.float64]
Indices = NDArray[np.int64]


@dataclass(frozen=True, eq=False)
class Places(TensorGroup):
    """Counts of relations between classes, of the roles of boxes, and of objects on the floor."""

    prefix: ClassVar[str] = "places."
    integers = ("triple", "role_pair")
    stored_as: ClassVar[Mapping[str, str]] = {"triple_scenes": "held"}

    triple: Annotated[NDArray[np.int32], "N"]  # keys (a V + i) V + j of a(i, j), ascending
    triple_scenes: Annotated[NDArray[np.float32], "N"]  # number of training scenes with each triple
    frequency: Annotated[NDArray[np.float32], "V"]  # share of the listed classes in training
    role_pair: Annotated[NDArray[np.int32], "P"]  # this and the next two: see `RoleCounts`
    role_counts: Annotated[NDArray[np.float32], "P", 3]
    role_anchor: Annotated[NDArray[np.float32], "V", 3]
    stands: Annotated[NDArray[np.float32], "V", 3]  # shares: on the floor, hanging, supported

    def check(self, A: int, V: int, C: int) -> None:
        """Check the values for a machine with A relations and V classes."""
        self.require(len(self.triple), "there must be at least one triple")
        self.require_keys("triple", A * V * V)
        self.require_keys("role_pair", V * V)
        counts = self.triple_scenes, self.role_counts, self.role_anchor, self.stands
        is_right = all((array >= 0).all() for array in counts) and (self.frequency > 0).all()
        self.require(is_right, "counts must be at least 0, and frequencies must be above 0")

    @cached_property
    def roles(self) -> RoleCounts:
        """The roles of pairs of classes."""
        return RoleCounts(self.role_pair.astype(np.int64), self.role_counts, self.role_anchor)

    def log_ratio(self, relation: int, anchor: int, *, outgoing: bool) -> Float[Floats, "V"]:
        """Return log p(i at a, j) - log p(i) of each class i, with relation a and anchor class j.

        ``outgoing`` means that the class i is the subject of the relation, and not the anchor.
        """
        start, classes, counts, back_off = self._by_anchor[int(outgoing)]
        V = len(self.frequency)
        begin, end = start[relation * V + anchor], start[relation * V + anchor + 1]
        smoothed = _PLACE * back_off[relation]
        smoothed[classes[begin:end]] += counts[begin:end]
        return np.log(smoothed / ((counts[begin:end].sum() + _PLACE) * self.frequency))

    def shows(
        self, relation: int, subject: Int[Indices, "N"], other: Int[Indices, "M"]
    ) -> Bool[NDArray[np.bool_], "N M"]:
        """Return whether training shows a relation of classes. A single scene may be an error."""
        V = len(self.frequency)
        return (
            _triple_counts(self.triple, self.triple_scenes, V, relation, subject, other) >= _SHOWN
        )

    def supporters(
        self, subject: Int[Indices, "N"], other: Int[Indices, "M"]
    ) -> Float[Floats, "N M"]:
        """Return the share of each class among the objects on or in which each subject class is."""
        total, share = self._supporters
        V, of_pairs = len(self.frequency), _SUPPORTER * share[other]
        for a in SUPPORTS:
            of_pairs = of_pairs + _triple_counts(
                self.triple, self.triple_scenes, V, a, subject, other
            )
        return of_pairs / (total[subject, None] + _SUPPORTER)

    @cached_property
    def _supporters(self) -> tuple[Float[Floats, "V"], Float[Floats, "V"]]:
        """Number of supporters of each class, and its share among all supporters."""
        V = len(self.frequency)
        is_support = np.isin(self.triple // (V * V), SUPPORTS)
        subject, other = np.divmod(self.triple[is_support] % (V * V), V)
        scenes = self.triple_scenes[is_support]
        total, count = (np.bincount(role, scenes, V).astype(float) for role in (subject, other))
        return total, (count + _SEEN) / (count + _SEEN).sum()

    @cached_property
    def unseen(self) -> tuple[UInt8[NDArray, "V V"], Float[NDArray, "3 V"]]:
        """Stacked relations that training shows, and the change of the log-odds of the others.

        The change is the log share of the subject's stand, at most `USUAL`: on a wall for above, on
        or in an object for on-top and inside. So a blackboard does not stand on a chair. The values
        are the first two arguments of `add_unseen`.
        """
        shares = np.log(np.minimum(np.maximum(self.stands, _LEAST_STAND) / USUAL, 1.0))
        every = np.arange(len(shares))
        shown = np.zeros((len(every), len(every)), np.uint8)
        for bit, a in enumerate(STACKED):
            shown |= self.shows(a, every, every).astype(np.uint8) << bit
        return shown, shares.T[[SUPPORTED, HANGS, SUPPORTED]].astype(np.float32)

    def under_evidence(self, upper: int, lower: int) -> float:
        """Return log(n · n / m), with n scenes that show the lower class under the upper.

        m is the number of scenes that show it on or in the upper class. So the value is large if
        this role is usual, or if many scenes show it. It is -inf if no scene shows it.
        """
        counts = role_counts(self.roles, lower, upper).astype(float)
        if counts[UNDER] <= 0:
            return -math.inf
        return math.log(counts[UNDER] ** 2 / (counts[ON] + counts[IN] + _OTHER_ROLES))

    def means_under(self, upper: int, lower: int) -> bool:
        """Return whether "upper on top of lower" means lower under upper, as with desk and bin."""
        under = role_counts(self.roles, lower, upper)[UNDER]
        return bool(under >= _SHOWN and under > role_counts(self.roles, upper, lower)[ON])

    @cached_property
    def _by_anchor(self) -> tuple[tuple[NDArray[Any], ...], ...]:
        """For anchors as subjects, then as objects: the triples in the order of their anchor.

        The arrays are the first row of each (relation, anchor) and the end, (A V + 1,); class i and
        number of scenes of each row, both (N,); and p(i at a), (A, V).
        """
        V = len(self.frequency)
        a, i, j = self.triple // V // V, self.triple // V % V, self.triple % V
        A = len(CANONICAL)  # a relation may have no triple
        share = self.frequency.astype(np.float64) / self.frequency.sum()
        tables = []
        for anchor, other in ((i, j), (j, i)):
            key = a.astype(np.int64) * V + anchor
            order = np.argsort(key, kind="stable")
            back_off = np.zeros((A, V)) + _RELATION * share
            np.add.at(back_off, (a, other), self.triple_scenes)
            back_off /= back_off.sum(1, keepdims=True)
            start = np.searchsorted(key[order], np.arange(A * V + 1))
            tables.append(
                (start, other[order], self.triple_scenes[order].astype(np.float64), back_off)
            )
        return tuple(tables)


@compiled
def add_unseen(
    shown: UInt8[NDArray, "V V"],  # bit a: training shows relation a of `STACKED`
    change: Float[NDArray, "3 V"],  # for each subject class
    candidates: Int[NDArray, " N"],
    classes: Int[NDArray, " m"],
    forward: Float[NDArray, "N A m"],  # log-odds with the candidate as subject
    backward: Float[NDArray, "N A m"],  # log-odds with the other class as subject
) -> None:
    """Add the changes of stacked relations that training never shows to log-odds, in place."""
    for c in range(len(candidates)):
        for a in range(forward.shape[1] - ON_TOP):
            for k in range(len(classes)):
                i, j = candidates[c], classes[k]
                if not shown[i, j] >> a & 1:
                    forward[c, ON_TOP + a, k] += change[a, i]
                if not shown[j, i] >> a & 1:
                    backward[c, ON_TOP + a, k] += change[a, j]


@compiled
def _triple_counts(
    triple: Int[NDArray, " R"],
    triple_scenes: Float[NDArray, " R"],
    V: int,
    relation: int,
    subject: Int[NDArray, " N"],
    other: Int[NDArray, " M"],
) -> Float[NDArray, "N M"]:
    """Return the counts of the triples (relation, subject, other), 0 without an entry."""
    counts = np.zeros((len(subject), len(other)))
    for i in range(len(subject)):
        for j in range(len(other)):
            row = find_row(triple, (relation * V + subject[i]) * V + other[j])
            if row >= 0:
                counts[i, j] = triple_scenes[row]
    return counts
