"""The kernels of `gpom_core.kernels` with their derivatives by the logarithm of the length scale.

Of the squared exponential, d k / d log l = r^2 / l^2 k. Averaged over a line this stays in closed
form, since w^2 exp(-w^2 / 2) has -w exp(-w^2 / 2) + (integral of exp(-w^2 / 2)) as its integral;
boxes separate into axes, and the product rule does the rest. "Slope" is this derivative throughout.
"""

from typing import Final

import numpy as np
from numpy.typing import NDArray

from gpom_core.averages import CUTOFF, interval_averages
from gpom_core.jit import compiled
from gpom_core.layout import distinct_intervals, line_nodes, whitened
from gpom_core.quadrature import NODES, WEIGHTS
from gpom_core.shapes import Kind
from gpom_core.special import exp_neg

_Floats = NDArray[np.float64]
_Integers = NDArray[np.int64]

_BOX: Final = int(Kind.BOX)
_SHORT: Final = 0.45  # below, the closed form divides its rounding error by the length
_SHORT_NODES: Final = 6


def gram_with_slope(
    kinds: NDArray[np.uint8], geometry: _Floats, length_scale_m: float
) -> tuple[_Floats, _Floats]:
    """Kernel between all pairs of shapes, and its derivative by the log of the length scale.

    Args:
        kinds: (n,) values of `Kind`. geometry: (n, 2, d), C-contiguous float64, metres.
        length_scale_m: of all axes.

    Returns:
        Both (n, n) and symmetric. The value is that of `kernels.gram`; the slope's absolute error
        is below 1e-8.
    """
    n, _, d = geometry.shape
    value, slope = np.empty((n, n)), np.empty((n, n))
    inverse = np.full(d, 1.0 / length_scale_m)
    gram_with_slope_into(kinds, geometry, inverse, value, slope)
    return value, slope


@compiled
def gram_with_slope_into(
    kinds: NDArray[np.uint8], geometry: _Floats, inverse: _Floats, value: _Floats, slope: _Floats
) -> None:
    """`gram_with_slope`, written into value and slope (n, n); inverse length scales are (d,)."""
    lines = np.flatnonzero(kinds != _BOX)
    start, span = whitened(geometry, lines, inverse)
    if lines.size > 0:
        line_value, line_slope = line_gram_with_slope(start, span)
        for i in range(lines.size):
            for j in range(lines.size):
                value[lines[i], lines[j]] = line_value[i, j]
                slope[lines[i], lines[j]] = line_slope[i, j]
    boxes = np.flatnonzero(kinds == _BOX)
    if boxes.size == 0:
        return
    low, width = whitened(geometry, boxes, inverse)
    interval, interval_low, interval_width, count = distinct_intervals(low, width)
    _boxes_with_boxes(boxes, interval, interval_low, interval_width, count, value, slope)
    if lines.size > 0:
        node, weight, first = line_nodes(start, span)
        at_value, at_slope = _boxes_at_points(interval, interval_low, interval_width, count, node)
        for b in range(boxes.size):
            for j in range(lines.size):
                v, g = 0.0, 0.0
                for q in range(first[j], first[j + 1]):
                    v += weight[q] * at_value[b, q]
                    g += weight[q] * at_slope[b, q]
                value[boxes[b], lines[j]] = v
                value[lines[j], boxes[b]] = v
                slope[boxes[b], lines[j]] = g
                slope[lines[j], boxes[b]] = g


@compiled
def line_averages_with_slope(
    s: _Floats, r2: _Floats, length: float, value: _Floats, slope: _Floats
) -> None:
    """`averages.line_averages` and its slope, at points s along a line and r2 from its axis."""
    if length == 0.0:
        for k in range(s.size):
            value[k] = exp_neg(-0.5 * r2[k])
            slope[k] = r2[k] * value[k]
        return
    interval_averages(s, length, value)
    if length > _SHORT:
        share = 1.0 / length
        for k in range(s.size):
            left = length - s[k]
            ends = left * exp_neg(-0.5 * left * left) + s[k] * exp_neg(-0.5 * s[k] * s[k])
            slope[k] = value[k] - share * ends
    else:
        slope[:] = 0.0
        for q in range(_SHORT_NODES):
            u, weight = NODES[_SHORT_NODES - 1, q] * length, WEIGHTS[_SHORT_NODES - 1, q]
            for k in range(s.size):
                w2 = (s[k] - u) * (s[k] - u)
                slope[k] += weight * w2 * exp_neg(-0.5 * w2)
    for k in range(s.size):
        across = exp_neg(-0.5 * r2[k])
        slope[k] = across * (slope[k] + r2[k] * value[k])
        value[k] *= across


@compiled
def line_gram_with_slope(start: _Floats, span: _Floats) -> tuple[_Floats, _Floats]:
    """`averages.line_gram` of n lines (d, n), and its slope; (n, n) both.

    Of each pair the longer line is integrated in closed form, the shorter by Gauss-Legendre.
    """
    d, n = start.shape
    value, slope = np.zeros((n, n)), np.zeros((n, n))
    node, weight, first = line_nodes(start, span)
    length = np.empty(n)
    for j in range(n):
        length[j] = np.sqrt(np.sum(span[:, j] * span[:, j]))
    s, r2 = np.empty(first[n]), np.empty(first[n])
    v, g = np.empty(first[n]), np.empty(first[n])
    near = np.empty(n, np.int64)
    t = np.zeros(d)
    for i in range(n):
        for axis in range(d):
            t[axis] = span[axis, i] / length[i] if length[i] > 0.0 else 0.0
        found, filled = 0, 0
        for j in range(n):
            if length[j] > length[i] or (length[j] == length[i] and j < i):
                continue
            if _gap2(start, span, i, j) > CUTOFF * CUTOFF:
                continue
            near[found] = j
            found += 1
            for q in range(first[j], first[j + 1]):
                along, squared = 0.0, 0.0
                for axis in range(d):
                    offset = node[axis, q] - start[axis, i]
                    along += offset * t[axis]
                    squared += offset * offset
                s[filled] = along
                r2[filled] = squared - along * along
                filled += 1
        line_averages_with_slope(s[:filled], r2[:filled], length[i], v, g)
        filled = 0
        for k in range(found):
            j = near[k]
            total, total_slope = 0.0, 0.0
            for q in range(first[j], first[j + 1]):
                total += weight[q] * v[filled]
                total_slope += weight[q] * g[filled]
                filled += 1
            value[i, j], value[j, i] = total, total
            slope[i, j], slope[j, i] = total_slope, total_slope
    return value, slope


@compiled
def _gap2(start: _Floats, span: _Floats, i: int, j: int) -> float:
    """Squared distance of the bounding boxes of two lines."""
    total = 0.0
    for axis in range(len(start)):
        a, b = start[axis, i], start[axis, j]
        e, f = span[axis, i], span[axis, j]
        gap = max(min(a, a + e) - max(b, b + f), min(b, b + f) - max(a, a + e))
        if gap > 0.0:
            total += gap * gap
    return total


@compiled
def _boxes_with_boxes(
    boxes: _Integers,
    interval: _Integers,
    low: _Floats,
    width: _Floats,
    count: _Integers,
    value: _Floats,
    slope: _Floats,
) -> None:
    d, n = interval.shape
    for axis in range(d):
        used = count[axis]
        table, table_slope = line_gram_with_slope(
            low[axis : axis + 1, :used], width[axis : axis + 1, :used]
        )
        for i in range(n):
            for j in range(n):
                a, b = boxes[i], boxes[j]
                v = table[interval[axis, i], interval[axis, j]]
                g = table_slope[interval[axis, i], interval[axis, j]]
                if axis > 0:
                    g = slope[a, b] * v + value[a, b] * g
                    v *= value[a, b]
                value[a, b] = v
                slope[a, b] = g


@compiled
def _boxes_at_points(
    interval: _Integers, low: _Floats, width: _Floats, count: _Integers, points: _Floats
) -> tuple[_Floats, _Floats]:
    """Kernel between n boxes and m points (d, m), and its slope; (n, m) both."""
    d, n = interval.shape
    m = points.shape[1]
    value, slope = np.empty((n, m)), np.empty((n, m))
    offset, on_axis = np.empty(m), np.zeros(m)
    for axis in range(d):
        table, table_slope = np.empty((count[axis], m)), np.empty((count[axis], m))
        for u in range(count[axis]):
            for k in range(m):
                offset[k] = points[axis, k] - low[axis, u]
            line_averages_with_slope(offset, on_axis, width[axis, u], table[u], table_slope[u])
        for i in range(n):
            v, g = table[interval[axis, i]], table_slope[interval[axis, i]]
            for k in range(m):
                if axis == 0:
                    value[i, k], slope[i, k] = v[k], g[k]
                else:
                    slope[i, k] = slope[i, k] * v[k] + value[i, k] * g[k]
                    value[i, k] *= v[k]
    return value, slope
