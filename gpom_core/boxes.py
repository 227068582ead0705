"""Kernels of axis-aligned boxes, from tables of one-dimensional values.

A box kernel is a product over axes, and boxes of one lattice share their sides. So each distinct
side is integrated once per axis, and every pair of shapes costs one lookup and one product per
axis. Boxes that share nothing cost no more than without tables. Everything is whitened.
"""

import numpy as np
from numpy.typing import NDArray

from gpom_core.averages import interval_averages, line_gram
from gpom_core.jit import compiled
from gpom_core.layout import distinct_intervals

_Floats = NDArray[np.float64]
_Integers = NDArray[np.integer]


@compiled
def box_gram(low: _Floats, width: _Floats, place: _Integers, out: _Floats) -> None:
    """Kernel between all pairs of n boxes, given by low corners and widths (d, n).

    The pair (i, j) is written to out[place[i], place[j]] and its mirror image.
    """
    d, n = low.shape
    sides, side_low, side_width, count = distinct_intervals(low, width)
    side = sides.astype(np.uint64)  # unsigned indices: no test for wrapping round
    target = place.astype(np.uint64)
    for axis in range(d):
        used = count[axis]
        table = np.empty((used, used))
        line_gram(
            side_low[axis : axis + 1, :used].copy(),
            side_width[axis : axis + 1, :used].copy(),
            np.arange(used),
            table,
        )
        for i in range(n):
            values = table[side[axis, i]]
            row = out[target[i]]
            if axis == 0:
                for j in range(n):
                    row[target[j]] = values[side[axis, j]]
            else:
                for j in range(n):
                    row[target[j]] *= values[side[axis, j]]


@compiled
def box_rows(low: _Floats, width: _Floats, points: _Floats, out: _Floats) -> None:
    """Kernel between n boxes (d, n) and m points (d, m), into out (n, m)."""
    d, n = low.shape
    m = points.shape[1]
    sides, side_low, side_width, count = distinct_intervals(low, width)
    side = sides.astype(np.uint64)  # unsigned indices: no test for wrapping round
    offset = np.empty(m)
    for axis in range(d):
        table = np.empty((count[axis], m))
        for u in range(count[axis]):
            a = side_low[axis, u]
            for k in range(m):
                offset[k] = points[axis, k] - a
            interval_averages(offset, side_width[axis, u], table[u])
        for i in range(n):
            values = table[side[axis, i]]
            row = out[i]
            if axis == 0:
                for k in range(m):
                    row[k] = values[k]
            else:
                for k in range(m):
                    row[k] *= values[k]
