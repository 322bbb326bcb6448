"""Names for the types of arrays and of their random generator."""

import numpy as np
from jaxtyping import Bool
from numpy.typing import NDArray

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]
Flags = NDArray[np.bool_]
Rng = np.random.Generator
ClassMask = Bool[NDArray, "V"]
"""True for some of the V classes."""
