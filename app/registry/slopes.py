"""The relation entries of a calibration, as arrays for the compiled kernels."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from app.registry.description import Calibration, PairSlope

Table = NDArray[np.float32]


@dataclass(frozen=True, slots=True, eq=False)
class RelationSlopes:
    """Calibration tables of the A canonical relations, each (A, 4 + 2K).

    Each row of a table is the `PairSlope` of one relation: intercept, slope, log_count,
    log_classes, and K bends of two numbers each.

    Attributes:
        alone: table for scenes without observed relations.
        given: table for scenes with observed relations.
        placement: table for a missing object at its most probable places.
        asked_place: table for a missing object at the place that a request names.
    """

    alone: Table
    given: Table
    placement: Table
    asked_place: Table

    @classmethod
    def of(cls, calibration: Calibration) -> RelationSlopes:
        """Build the tables of a calibration."""
        return cls(
            _table(calibration.relation),
            _table(calibration.relation_given),
            _table(calibration.placement),
            _table(calibration.asked_place),
        )


def _table(entries: tuple[PairSlope, ...]) -> Table:
    bends = max((len(e.bends) for e in entries), default=0)
    table = np.zeros((len(entries), 4 + 2 * bends), np.float32)
    for row, e in zip(table, entries, strict=True):
        row[:4] = e.intercept, e.slope, e.log_count, e.log_classes
        row[4 : 4 + 2 * len(e.bends)] = np.ravel(e.bends)
    return table
