"""Names for the types of arrays and of their random generator, and the base of tables."""

from dataclasses import fields
from typing import Any, Self, cast

import numpy as np
from jaxtyping import Bool
from numpy.typing import NDArray

Floats = NDArray[np.float64]
Rng = np.random.Generator
ClassMask = Bool[NDArray, "V"]  # True for some of the V classes


class Table:
    """Base of dataclasses whose fields are arrays or tensors of N rows."""

    def rows(self, index: Any) -> Self:
        """Return the rows at the indices, or the rows where a mask is True."""
        return type(self)(*(column[index] for column in self.columns))

    def __len__(self) -> int:
        return len(self.columns[0])

    @property
    def columns(self) -> list[Any]:
        """The values of the fields, in order."""
        return [getattr(self, field.name) for field in fields(cast("Any", self))]
