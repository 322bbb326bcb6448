"""Compiled products of a few rows, four of them at a time: one load then serves four sums."""

from __future__ import annotations

import numpy as np

from app.compiling import compiled_in_any_order

ROWS = 4
"""The number of rows is a multiple of it; those that fill up are zero."""


@compiled_in_any_order
def add_products(rows, points, out):
    """out (N, R) += points (N, H) rows', for rows (R, H)."""
    for r in range(0, len(rows), 4):
        a, b, c, d = rows[r], rows[r + 1], rows[r + 2], rows[r + 3]
        for n in range(len(points)):
            x = points[n]
            p = q = s = t = np.float32(0.0)
            for h in range(len(x)):
                p += a[h] * x[h]
                q += b[h] * x[h]
                s += c[h] * x[h]
                t += d[h] * x[h]
            out[n, r] += p
            out[n, r + 1] += q
            out[n, r + 2] += s
            out[n, r + 3] += t


@compiled_in_any_order
def add_rows(weight, rows, out):
    """out (H,) += weight (R,) rows, for rows (R, H)."""
    for r in range(0, len(rows), 4):
        a, b, c, d = rows[r], rows[r + 1], rows[r + 2], rows[r + 3]
        p, q, s, t = weight[r], weight[r + 1], weight[r + 2], weight[r + 3]
        for h in range(len(out)):
            out[h] += p * a[h] + q * b[h] + s * c[h] + t * d[h]
