"""Implications: the change of a relation's logit by other relations that hold.

`training/machines/triway.py` defines the features of a pair of classes. Their weights depend on the
hidden units; see `RelationUnits.implication_weights`.
"""

import numpy as np

from app.compiling import compiled, inlined
from app.inference.elementary import logistic

# `draw_in_groups` samples the relations in 2 * _GROUPS groups.
_GROUPS = 4
# Limit of a degree feature. This feature counts the relations of one kind that a class has. More
# than three relations add little information.
_MOST = np.float32(3.0)


@compiled
def implication_shifts(weight, n, a, i, j):
    """Return how much the relations that hold change the logit of each relation, twice (n, n, A).

    The first array has the changes by all relations that hold. In the second one, relations between
    the same two classes do not change each other's logits.

    Args:
        weight: see `_shifts`.
        n: number of classes in the scene.
        a, i, j: (E,) indices of the relations that hold, of their subject classes and of their
            object classes. Subject and object class differ.
    """
    tables = _empty_steps(weight.shape[1], n)
    for e in range(len(a)):
        _add_relation(tables, weight, a[e], i[e], j[e])
    return _shifts(tables, weight, True), _shifts(tables, weight, False)


@compiled
def draw_in_groups(weight, logits, free, uniform, group_numbers, r):
    """Sample relations that change each other's logits, group after group.

    Each group is sampled given the relations of all earlier groups. The function assigns relations
    to groups at random. But a(i, j) and a(j, i) are always in different groups.

    Args:
        weight: see `_shifts`.
        logits: (A, n, n) logits of the relations without the changes by other relations.
        free: (A, n, n) bool, True for relations to sample. Other relations keep their value.
        uniform: (A, n, n) random numbers in [0, 1) that decide whether each relation holds.
        group_numbers: (A, n, n) random numbers in [0, 1) that select the group of each relation.
        r: (A, n, n) bool, True for relations that hold. The function writes the samples into r.
    """
    A, n, _ = r.shape
    tables, group = _empty_steps(A, n), np.empty(r.shape, np.int64)
    for a in range(A):
        for i in range(n):
            for j in range(n):
                group[a, i, j] = -1
                if free[a, i, j]:
                    # a(i, j) and a(j, i) share one random number, which decides whether a(i, j) or
                    # a(j, i) is sampled first.
                    first_is_late = group_numbers[a, min(i, j), max(i, j)] < 0.5
                    half = _GROUPS if first_is_late == (i < j) else 0
                    number = np.int64(2 * _GROUPS * group_numbers[a, i, j]) % _GROUPS
                    group[a, i, j] = half + number
    # Turn -1 only adds the relations that are on and not free.
    for turn in range(-1, 2 * _GROUPS):
        if turn >= 0:
            shift = _shifts(tables, weight, True)
            for a in range(A):
                for i in range(n):
                    for j in range(n):
                        if group[a, i, j] == turn:
                            p = logistic(logits[a, i, j] + shift[i, j, a])
                            r[a, i, j] = uniform[a, i, j] < p
        for a in range(A):
            for i in range(n):
                for j in range(n):
                    if group[a, i, j] == turn and r[a, i, j] and i != j:
                        _add_relation(tables, weight, a, i, j)


@compiled
def _empty_steps(relations, n):
    """Return the empty step tables of a scene of n classes without relations.

    A step leads from one class to another class along a relation that holds. A step of kind a leads
    from the subject to the object of relation a. A step of kind A + a leads from the object to the
    subject of relation a.

    Returns:
        degree: (2A kinds, n classes) number of steps of each kind that start at each class.
        near: (2A kinds, n classes, n) end classes of these steps.
        path_kinds: (n, n, 2A) paths of two steps from one class to another. The last axis is the
            kind of the first step. Each value is a bit set of the kinds of the second step.
        paths: (n, n, A) change of the logit of each relation by the paths between its two classes.
    """
    steps = 2 * relations
    degree, near = np.zeros((steps, n), np.int64), np.empty((steps, n, n), np.int64)
    path_kinds = np.zeros((n, n, steps), np.uint64)
    return degree, near, path_kinds, np.zeros((n, n, relations), np.float32)


@compiled
def _add_relation(tables, weight, a, i, j):
    """Add the steps of relation a between classes i and j, and the new paths, to the tables."""
    # The loops use plain indices, because a slice would cost more time.
    degree, near, path_kinds, paths = tables
    steps = len(degree)
    directions = (a, i, j), (steps // 2 + a, j, i)
    for c, x, y in directions:
        near[c, x, degree[c, x]] = y
        degree[c, x] += 1
    for c, x, y in directions:
        for d in range(steps):
            for step in range(degree[d, y]):
                _add_path(path_kinds, paths, weight, x, near[d, y, step], c, d)
            # If a step of kind d leads from x to another class, then a step of the opposite kind
            # leads from the other class to x.
            back = (d + steps // 2) % steps
            for step in range(degree[d, x]):
                _add_path(path_kinds, paths, weight, near[d, x, step], y, back, c)


@inlined
def _add_path(path_kinds, paths, weight, x, y, first, second):
    """Add a path of two steps (kinds first, second) from x to y, unless it is in the tables."""
    steps, bit = path_kinds.shape[2], np.uint64(1) << np.uint64(second)
    if not path_kinds[x, y, first] & bit:
        path_kinds[x, y, first] |= bit
        for b in range(paths.shape[2]):
            paths[x, y, b] += weight[steps + first * steps + second, b]


@compiled
def _shifts(tables, weight, direct):
    """Return how much the relations that hold change the logit of each relation, (n, n, A).

    Args:
        tables: step tables of the relations that hold; see `_empty_steps`.
        weight: (F, A) weights of the F features of relations that hold; see
            `RelationUnits.implication_weights`.
        direct: True if relations between the same two classes change each other's logits.
    """
    degree, near, _, paths = tables
    (steps, n), A = degree.shape, weight.shape[1]
    shift, degrees = paths.copy(), weight[steps + steps * steps :]
    out_shift, in_shift = np.zeros((n, A), np.float32), np.zeros((n, A), np.float32)
    for c in range(steps):
        # Each step of kind c that ends at a class has an opposite step that starts at this class.
        back = (c + A) % steps
        for x in range(n):
            for b in range(A):
                out_shift[x, b] += degrees[c, b] * min(np.float32(degree[c, x]), _MOST)
                in_shift[x, b] += degrees[steps + c, b] * min(np.float32(degree[back, x]), _MOST)
    for x in range(n):
        for y in range(n):
            for b in range(A):
                shift[x, y, b] += out_shift[x, b] + in_shift[y, b]
    for c in range(steps):
        back = (c + A) % steps
        for x in range(n):
            for step in range(degree[c, x]):
                y = near[c, x, step]
                for b in range(A):
                    if direct:
                        shift[x, y, b] += weight[c, b]
                    # The degree features for the pair (x, y) must not count the step from x to y.
                    if degree[c, x] <= _MOST:
                        shift[x, y, b] -= degrees[c, b]
                    if degree[back, y] <= _MOST:
                        shift[x, y, b] -= degrees[steps + c, b]
    return shift
