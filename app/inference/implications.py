"""Implications: the change of a relation's logit by other relations that hold.

`training/machines/triway.py` defines the F features of a pair of classes, and
`RelationUnits.implication_weights` their weights.
"""

from __future__ import annotations

from typing import Final

import numpy as np
from jaxtyping import Bool, Float
from numpy.typing import NDArray

from app.compiling import compiled
from app.inference.elementary import logistic

# `draw_in_groups` samples the relations in 2 * _GROUPS groups.
_GROUPS: Final = 4
# Limit of a degree feature. This feature counts the relations of one kind that a class has. More
# than three relations add little information.
_MOST: Final = np.float32(3.0)


@compiled
def implication_shifts(
    weight: Float[NDArray, "F A"], r: Bool[NDArray, "A n n"]
) -> Float[NDArray, "n n A"]:
    """Return the change of each relation's logit by the relations r that hold.

    A step leads from one class to another class along a relation that holds. A step of kind a leads
    from the subject to the object of relation a. A step of kind A + a leads from the object to the
    subject. A path consists of two steps. `weight` has a row for each kind of a step from x to y.
    Then follow the pairs of kinds of a path, the kinds of steps from x, and those of steps to y. x,
    y and z are classes, c and d are kinds, and b is the relation whose logit changes.
    """
    # The loops use plain indices, because a slice would cost more time.
    A, n, _ = r.shape
    kinds, degrees = 2 * A, weight[2 * A * (1 + 2 * A) :]
    # Number of steps of each kind that start at each class, and the ends of these steps.
    degree, near = np.zeros((kinds, n), np.int64), np.empty((kinds, n, n), np.int64)
    for a in range(A):
        for i in range(n):
            for j in range(n):
                if r[a, i, j] and i != j:
                    near[a, i, degree[a, i]], near[A + a, j, degree[A + a, j]] = j, i
                    degree[a, i] += 1
                    degree[A + a, j] += 1
    # Each step of kind c that ends at a class has a step of kind (c + A) % kinds that starts there.
    out_shift, in_shift = np.zeros((n, A), np.float32), np.zeros((n, A), np.float32)
    for c in range(kinds):
        back = (c + A) % kinds
        for x in range(n):
            for b in range(A):
                out_shift[x, b] += degrees[c, b] * min(np.float32(degree[c, x]), _MOST)
                in_shift[x, b] += degrees[kinds + c, b] * min(np.float32(degree[back, x]), _MOST)
    shift = np.empty((n, n, A), np.float32)
    for x in range(n):
        for y in range(n):
            for b in range(A):
                shift[x, y, b] = out_shift[x, b] + in_shift[y, b]
    # Bit d of paths[x, c, z] is set if a path of the kinds c and d leads from x to z.
    paths = np.zeros((n, kinds, n), np.int64)
    for c in range(kinds):
        back = (c + A) % kinds
        for x in range(n):
            for first in range(degree[c, x]):
                y = near[c, x, first]
                for b in range(A):
                    shift[x, y, b] += weight[c, b]
                    # The degree features for the pair (x, y) must not count the step from x to y.
                    if degree[c, x] <= _MOST:
                        shift[x, y, b] -= degrees[c, b]
                    if degree[back, y] <= _MOST:
                        shift[x, y, b] -= degrees[kinds + c, b]
                for d in range(kinds):
                    for second in range(degree[d, y]):
                        z = near[d, y, second]
                        if not paths[x, c, z] >> d & 1:
                            paths[x, c, z] |= 1 << d
                            for b in range(A):
                                shift[x, z, b] += weight[kinds * (1 + c) + d, b]
    return shift


@compiled
def draw_in_groups(
    weight: Float[NDArray, "F A"],
    logits: Float[NDArray, "A n n"],
    free: Bool[NDArray, "A n n"],
    uniform: Float[NDArray, "A n n"],
    group_numbers: Float[NDArray, "A n n"],
    r: Bool[NDArray, "A n n"],
) -> None:
    """Sample the free relations of r, which are off before, group after group.

    Each group is sampled given the relations of all earlier groups. a(i, j) and a(j, i) are always
    in different groups. `uniform` and `group_numbers` are random numbers in [0, 1): the first draw
    the relations, and the second select the groups. `logits` lack the changes by other relations.
    """
    A, n, _ = r.shape
    group = np.empty(r.shape, np.int64)
    for a in range(A):
        for i in range(n):
            for j in range(n):
                # a(i, j) and a(j, i) share one random number, which decides whether a(i, j) or
                # a(j, i) is sampled first.
                first_is_late = group_numbers[a, min(i, j), max(i, j)] < 0.5
                half = _GROUPS if first_is_late == (i < j) else 0
                number = np.int64(2 * _GROUPS * group_numbers[a, i, j]) % _GROUPS
                group[a, i, j] = half + number if free[a, i, j] else -1
    for turn in range(2 * _GROUPS):
        shift = implication_shifts(weight, r)
        for a in range(A):
            for i in range(n):
                for j in range(n):
                    if group[a, i, j] == turn:
                        p = logistic(logits[a, i, j] + shift[i, j, a])
                        r[a, i, j] = uniform[a, i, j] < p
