"""U: what each triple that has a weight of its own says of the context."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from app.inference.weights import Weights


def context_rows(weights: Weights) -> NDArray[np.float32]:
    """U of all triples, (T, H1): free in RBM and GBM, formed from the factors in the others.

    U_e = P[a] + sum_k S[i,k] M[a,k] O[j,k]
    """
    if weights.spec.variant in ("rbm", "gbm"):
        free: NDArray[np.float32] = weights["U"]
        return free
    relation, subject, object_ = weights["triples"].astype(np.int64).T
    product = weights["S"][subject] * weights["O"][object_]
    rows: NDArray[np.float32] = weights["P"][relation]
    for a, shared in enumerate(weights["M"]):
        rows[relation == a] += product[relation == a] @ shared
    return rows
