"""A calibration's entries of relations as arrays, for the loops that answer."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from app.registry.description import Calibration, PairSlope

Table = NDArray[np.float32]


@dataclass(frozen=True, slots=True, eq=False)
class RelationSlopes:
    """Of each canonical relation intercept, slope, log_count, log_classes and K bends, (A, 4 + 2K).

    Attributes:
        alone: for scenes of which no relation is given.
        given: of which some are.
        placement: for a missing object and one that is there.
        asked_place: the same at the place that a request asks for.
    """

    alone: Table
    given: Table
    placement: Table
    asked_place: Table

    @classmethod
    def of(cls, calibration: Calibration) -> RelationSlopes:
        """The entries of a calibration, each kind standing in where another is empty."""
        alone = calibration.relation
        placement = calibration.placement or alone
        return cls(
            _table(alone),
            _table(calibration.relation_given or alone),
            _table(placement),
            _table(calibration.asked_place or placement),
        )


def _table(entries: tuple[PairSlope, ...]) -> Table:
    bends = max((len(e.bends) for e in entries), default=0)
    table = np.zeros((len(entries), 4 + 2 * bends), np.float32)
    for row, e in zip(table, entries, strict=True):
        row[:4] = e.intercept, e.slope, e.log_count, e.log_classes
        row[4 : 4 + 2 * len(e.bends)] = np.ravel(e.bends)
    return table
