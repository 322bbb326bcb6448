"""The relations of a scene in one table: stated by a request, shown by boxes, or excluded by boxes.

A request is read into this table once, and all questions read the table. A row is a relation of one
object to another object, with its probability: 1 or 0 for a stated relation, and between them for
one of boxes, which have errors. A relation holds if its probability is at least `HOLDS`.
"""

from collections.abc import Iterable, Sequence
from dataclasses import KW_ONLY, dataclass, replace
from functools import cached_property
from typing import Any, Final, TypeAlias

import numpy as np
from jaxtyping import Bool, Float32, Int
from numpy.typing import NDArray

from app.scene.spatial_relations import CANONICAL, HOLDS

Array: TypeAlias = NDArray[Any]
Triple: TypeAlias = tuple[int, int, int]
"""A canonical relation, its subject and its object, as indices."""

STATED, BOXES, EXCLUDED = range(3)
"""Origins of a row. The first two are observations: the request states the relation or that it does
not hold, or the boxes show this. A row of origin `EXCLUDED` observes nothing about other relations:
its relation alone cannot hold between these boxes."""

_A: Final = len(CANONICAL)
_COLUMNS: Final = ("relation", "subject", "object", "probability", "origin", "is_opposite")


@dataclass(frozen=True, eq=False)
class RelationTable:
    """R relations between different objects of a scene."""

    relation: Int[Array, "R"]
    subject: Int[Array, "R"]
    object: Int[Array, "R"]
    probability: Float32[Array, "R"]
    origin: Int[Array, "R"]  # `STATED`, `BOXES` or `EXCLUDED`
    is_opposite: Bool[Array, "R"]  # whether the request states the opposite, such as right for left
    _: KW_ONLY
    of_boxes: bool = False  # whether the observations come from boxes

    @classmethod
    def stated(
        cls,
        triples: Iterable[Triple],
        is_opposite: Sequence[bool] | None = None,  # by default, none
        *,
        complete_for: int | None = None,  # number of objects, if no other relations hold
    ) -> "RelationTable":
        """Return the table of the relations that a request states."""
        relation, subject, object_ = np.array(list(triples), np.int64).reshape(-1, 3).T
        n = len(relation)
        flags = np.zeros(n, np.bool_) if is_opposite is None else np.array(is_opposite, np.bool_)
        p = np.ones(n, np.float32)
        table = cls(relation, subject, object_, p, np.full(n, STATED), flags)
        if complete_for is None:
            return table
        return table.excluding(np.ones((_A, complete_for, complete_for), np.bool_), STATED)

    @classmethod
    def shown_by_boxes(
        cls,
        probability: Float32[Array, "A N N"],
        observed: Bool[Array, "A N N"],
        excluded: Bool[Array, "A N N"],  # relations that cannot hold, observed or not
    ) -> "RelationTable":
        """Return the table of the relations between N boxes."""
        a, i, j = _between_two(observed | excluded)
        origin = np.where(observed[a, i, j], BOXES, EXCLUDED)
        p = probability[a, i, j]
        return cls(a, i, j, p, origin, np.zeros(len(p), np.bool_), of_boxes=True)

    def excluding(self, grid: Bool[Array, "A N N"], origin: int) -> "RelationTable":
        """Return the table with relations that do not hold: those of a grid, unless they hold."""
        others, holding = grid.copy(), self.holding  # others: relations that do not hold
        others[holding.relation, holding.subject, holding.object] = False
        a, i, j = _between_two(others)
        probability = np.zeros(len(a), np.float32)
        new = a, i, j, probability, np.full(len(a), origin), np.zeros(len(a), np.bool_)
        columns = zip(_COLUMNS, new, strict=True)
        joined: dict[str, Any] = {
            name: np.concatenate([getattr(self, name), more]) for name, more in columns
        }
        return replace(self, **joined)

    def __len__(self) -> int:
        return len(self.relation)

    def rows(self, chosen: Bool[Array, "R"]) -> "RelationTable":
        """Return the chosen rows."""
        index = chosen.nonzero()[0]
        return replace(self, **{name: getattr(self, name).take(index) for name in _COLUMNS})

    def known(self, A: int) -> "RelationTable":
        """Return the rows whose relation a machine with A relations knows."""
        return self if A == _A else self.rows(self.relation < A)

    @cached_property
    def holding(self) -> "RelationTable":
        """The relations that hold, in the order of the request or of their indices."""
        return self.rows(self.probability >= HOLDS)

    @cached_property
    def triples(self) -> tuple[Triple, ...]:
        """The relations that hold."""
        columns = self.holding.relation, self.holding.subject, self.holding.object
        return tuple(zip(*(column.tolist() for column in columns), strict=True))

    @cached_property
    def opposites(self) -> frozenset[Triple]:
        """The relations that hold and that the request states by their opposite."""
        flags = self.holding.is_opposite.tolist()
        return frozenset(triple for triple, flag in zip(self.triples, flags, strict=True) if flag)

    def grids(self, N: int) -> tuple[Bool[Array, "A N N"], Bool[Array, "A N N"]]:
        """Return which relations between N objects hold, and which are observed."""
        holds, observed = np.zeros((2, _A, N, N), np.bool_)
        seen = self.rows(self.origin != EXCLUDED)
        cells = seen.relation, seen.subject, seen.object
        observed[cells], holds[cells] = True, seen.probability >= HOLDS
        return holds, observed

    def of_classes(
        self, row: Int[Array, "N"], n: int, A: int
    ) -> tuple[Int[Array, "E"], Int[Array, "E"], Int[Array, "E"], Float32[Array, "E"]] | None:
        """Return the observed relations between n classes, in the order of their indices.

        The results are relation, subject class, object class, and the largest probability of the
        relations between their objects; None without observations. Boxes observe something even if
        they show no relation. ``row`` is the class of each object, below n. The machine knows the
        first A relations.
        """
        is_observed = self.origin != EXCLUDED
        if not (self.of_boxes or is_observed.any()):
            return None
        used = is_observed & (self.relation < A)
        i, j = row[self.subject[used]], row[self.object[used]]
        grid = np.full(A * n * n, -1, np.float32)
        np.maximum.at(grid, (self.relation[used] * n + i) * n + j, self.probability[used])
        units = np.flatnonzero(grid >= 0)
        relation, pair = np.divmod(units, n * n)
        return relation, *np.divmod(pair, n), grid[units]


def _between_two(grid: Bool[Array, "A N N"]) -> tuple[Array, Array, Array]:
    """Return the indices of the relations that are True, without those of an object to itself."""
    a, i, j = grid.nonzero()
    other = i != j
    return a[other], i[other], j[other]
