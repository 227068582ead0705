"""How the shapes of one call are laid out for the loops over them: whitened, axis by axis.

Shared by the kernels and their gradients. Compiled, and unchecked as those are.
"""

import numpy as np
from numpy.typing import NDArray

from gpom_core.jit import compiled
from gpom_core.quadrature import fill_rule, node_count, panel_count

_Floats = NDArray[np.float64]
_Integers = NDArray[np.int64]


@compiled
def whitened(
    geometry: _Floats, chosen: _Integers, inverse_length_scale: _Floats
) -> tuple[_Floats, _Floats]:
    """Starts and spans of the chosen shapes, each (d, n), in length scales."""
    d = geometry.shape[2]
    start = np.empty((d, chosen.size))
    span = np.empty((d, chosen.size))
    for axis in range(d):
        for i in range(chosen.size):
            first = geometry[chosen[i], 0, axis]
            start[axis, i] = first * inverse_length_scale[axis]
            span[axis, i] = (geometry[chosen[i], 1, axis] - first) * inverse_length_scale[axis]
    return start, span


@compiled
def line_nodes(start: _Floats, span: _Floats) -> tuple[_Floats, _Floats, _Integers]:
    """Quadrature nodes (d, N) and weights (N,) of n lines; line j owns first[j]:first[j + 1]."""
    d, n = start.shape
    first = np.zeros(n + 1, np.int64)
    length = np.empty(n)
    for j in range(n):
        length[j] = np.sqrt(np.sum(span[:, j] * span[:, j]))
        first[j + 1] = first[j] + panel_count(length[j]) * node_count(length[j])
    position = np.empty(first[n])
    weight = np.empty(first[n])
    node = np.empty((d, first[n]))
    for j in range(n):
        fill_rule(length[j], position[first[j] :], weight[first[j] :])
        for axis in range(d):
            for q in range(first[j], first[j + 1]):
                node[axis, q] = start[axis, j] + position[q] * span[axis, j]
    return node, weight, first


@compiled
def distinct_intervals(
    low: _Floats, width: _Floats
) -> tuple[_Integers, _Floats, _Floats, _Integers]:
    """Distinct sides of boxes, per axis: boxes of one lattice share a few.

    Returns:
        Which interval each side is, (d, n); low and width of the intervals, (d, n) of which
        the first count[axis] are used; count (d,).
    """
    d, n = low.shape
    interval = np.empty((d, n), np.int64)
    interval_low = np.empty((d, n))
    interval_width = np.empty((d, n))
    count = np.zeros(d, np.int64)
    for axis in range(d):
        for i in range(n):
            found = 0
            while found < count[axis] and not (
                interval_low[axis, found] == low[axis, i]
                and interval_width[axis, found] == width[axis, i]
            ):
                found += 1
            interval[axis, i] = found
            if found == count[axis]:
                interval_low[axis, found] = low[axis, i]
                interval_width[axis, found] = width[axis, i]
                count[axis] += 1
    return interval, interval_low, interval_width, count
