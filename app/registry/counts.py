"""Statistics of the number of instances of a class in a scene, such as the chairs of a kitchen."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, ClassVar, Final, Self

import numpy as np
from numpy.typing import NDArray

from app.inference.kernels import INTERCEPT as INTERCEPT
from app.inference.kernels import ROOM as ROOM
from app.inference.kernels import SEVERAL as SEVERAL
from app.inference.kernels import SINGLE as SINGLE
from app.registry.errors import ArtifactError
from app.registry.fields import TensorGroup

Table = NDArray[np.float32]

PREFIX: Final = "counts."
"""Prefix of the names of count tensors. They are in the same file as the machine's tensors."""

EXPONENTS: Final = 2
"""Exponents of the formula: the first raises large numbers, and the second numbers between 1 and M.
"""

_LARGEST: Final = 64.0
_MOST: Final = 256


@dataclass(frozen=True, eq=False)
class Counts(TensorGroup):
    """Counts of K of a model's V classes. `app.questions.counts` has the formula.

    Attributes:
        classes: (K,) indices of the classes with statistics, in ascending order.
        most: (K,) maximum listed number, from 1 to M - 1. Too few groups of training scenes have
            more instances.
        log_share: (K, M) log of the share of scenes with 1, 2, ... instances, of the scenes with
            the class. The last column stands for M or more instances.
        weights: (K, 2, 3 + C + V) effects of the scene on the two exponents. A class has no effect
            on itself.
    """

    prefix: ClassVar[str] = PREFIX

    classes: NDArray[np.integer[Any]]
    most: NDArray[np.integer[Any]]
    log_share: Table
    weights: Table

    @classmethod
    def from_tensors(cls, tensors: Mapping[str, NDArray[Any]], V: int, C: int) -> Self:
        """Build the counts of a model with V classes and C room types from stored tensors.

        Raises:
            ArtifactError: `wrong_shape` if a tensor is missing, unexpected or of a wrong shape;
                `invalid_tensor` if a value is invalid.
        """
        K = len(np.atleast_1d(tensors.get(f"{PREFIX}classes", ())))
        M = np.atleast_1d(tensors.get(f"{PREFIX}log_share", ())).shape[-1]
        shapes = {
            "classes": (K,),
            "most": (K,),
            "log_share": (K, M),
            "weights": (K, EXPONENTS, ROOM + C + V),
        }
        counts = cls.read(tensors, shapes)
        if complaint := counts._complaint(V, C):
            raise ArtifactError("invalid_tensor", f"the count tensors are invalid: {complaint}")
        return counts

    def _complaint(self, V: int, C: int) -> str | None:
        for name in ("classes", "most"):
            if not np.issubdtype(getattr(self, name).dtype, np.integer):
                return f"{name} must be integers"
        for name in ("log_share", "weights"):
            if not np.issubdtype(getattr(self, name).dtype, np.floating):
                return f"{name} must be floating-point numbers"
        ascending = (self.classes[1:] > self.classes[:-1]).all()
        if not len(self.classes) or self.classes[0] < 0 or not ascending:
            return "classes must be non-negative, in ascending order, and at least one"
        if (self.classes[-1:] >= V).any():
            return "the tensor 'classes' has a class that the model does not have"
        if not 2 <= self.log_share.shape[1] <= _MOST:
            return f"log_share must have 2 to {_MOST} columns"
        if (self.most < 1).any() or (self.most >= self.log_share.shape[1]).any():
            return "most must be from 1 to the number of columns of log_share minus 1"
        if (self.log_share > 0).any() or (self.log_share < -_LARGEST).any():
            return f"log_share must be between -{_LARGEST:g} and 0"
        if (np.abs(self.weights) > _LARGEST).any():
            return f"weights must be between -{_LARGEST:g} and {_LARGEST:g}"
        if self.weights[np.arange(len(self.classes)), :, ROOM + C + self.classes].any():
            return "the weight of a class on itself must be 0"
        return None
