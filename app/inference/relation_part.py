"""The interface between the closed form and the relations of a variant."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float32]
Places = NDArray[np.int64]
Mask = NDArray[np.bool_]

NOTHING = np.zeros((0, 0, 0), dtype=np.float32)


@dataclass(frozen=True, slots=True)
class Given:
    """Relations that are given, on or off: E units between the n classes of a scene.

    Attributes:
        a: (E,) relation.
        i, j: (E,) places of subject and object class in the scene.
        r: (E,) 1 where it holds, else 0.
        g: (E,) presence of both ends.
    """

    a: Places
    i: Places
    j: Places
    r: Floats
    g: Floats

    @property
    def units(self) -> tuple[Places, Places, Places]:
        """a, i, j."""
        return self.a, self.i, self.j


@dataclass(frozen=True, slots=True)
class Context:
    """What is known of the context of a scene.

    Attributes:
        classes: (n,) int64, distinct.
        presence: (n,).
        log_counts: (n,) log of the instances of each.
        x: (H1,) logits of h1 given the objects.
        y: (H1,) given the relations as well, as questions about relations see it.
        given: the relations; None where there are none.
        slopes: (E,) as questions about relations see them.
        units: what the relation part keeps of the given units.
        object_y, object_slopes: y and slopes as questions about objects see them.
        through: (n, H1) what each class adds to y through the second layer; None with one layer.
    """

    classes: Places
    presence: Floats
    log_counts: Floats
    x: Floats
    y: Floats
    given: Given | None
    slopes: Floats
    units: Floats
    object_y: Floats
    object_slopes: Floats
    through: Floats | None


class Between(NamedTuple):
    """What the relations that are given say of those between the n classes; empty where none is.

    Attributes:
        slopes: (A, n, n), 0 where nothing is given.
        shift: (A, n, n) what they imply for each; apart: without those of the pair itself.
    """

    slopes: Floats
    shift: Floats
    apart: Floats


class RelationPart(Protocol):
    """Logits ℓ_e = w_e + U_e·h1 of the units of a variant; formulas in `closed_form`."""

    def fixed_point(
        self, x: Floats, classes: Places, presence: Floats, log_counts: Floats, given: Given
    ) -> tuple[Floats, Floats, Floats]:
        """The mean field given relations: y (H1,), slopes (E,), and what `units` shall hold."""

    def log_odds(self, context: Context, between: Between) -> Floats:
        """Of all relations between the classes, each without itself to first order, (A, n, n)."""

    def log_odds_apart(self, context: Context, between: Between, i: Places, j: Places) -> Floats:
        """Of pairs of classes (P,), without all that is given of the pair, (2, A, P)."""

    def without_itself(
        self, context: Context, units: tuple[Places, Places, Places], slopes: Floats, shift: Floats
    ) -> Floats:
        """Of some units (E,), each without itself, (E,)."""

    def implied(self, context: Context) -> tuple[Floats, Floats]:
        """`shift` and `apart` of `Between`."""

    def placement_log_odds(
        self, context: Context, candidates: Places, anchors: Places
    ) -> tuple[Floats, Floats]:
        """Of absent candidates to anchors and back, (N, A, m) both, were they there."""

    def placed_log_odds(
        self, context: Context, candidates: Places, relation: int, anchor: int, outgoing: bool
    ) -> Floats:
        """One relation of absent candidates to one anchor, or back, (N,)."""

    def shares(self, context: Context, given: Given) -> Floats:
        """What each class and its relations add to y, (n, H1)."""

    def common_growth(self, context: Context, given: Given, rows: Places) -> tuple[Floats, Mask]:
        """e^ what the relations between two classes add to y, (N, n, H1), and where there are any.

        Args:
            rows: (N,) places of classes.
        """
