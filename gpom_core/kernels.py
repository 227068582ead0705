"""Exact integral kernels of the squared exponential between points, segments and boxes.

An observation is a shape: a point, a line segment, or an axis-aligned box, in any dimension d.
All shapes of one call are one array `geometry` of shape (n, 2, d): a point is (p, p), a segment
(start, end), a box (low corner, high corner). The kernel between two shapes is the *average* of

    exp(-1/2 sum_j (x_j - x'_j)^2 / l_j^2)

over x in one and x' in the other, so a shape shrunk to a point is that point. Signal variance is
1; callers scale. The absolute error is below 1e-9 for any shape. Values below 1e-10 may come out as
zero, or as that much below it.

The functions ending in ``_into`` are compiled, release the interpreter lock, check nothing, and
may be called from compiled code. They take C-contiguous float64 arrays (kinds: uint8).
"""

from enum import IntEnum
from typing import Final

import numpy as np
from numpy.typing import ArrayLike, NDArray

from gpom_core.averages import interval_average, interval_averages, line_averages, line_gram
from gpom_core.jit import compiled
from gpom_core.quadrature import fill_rule, node_count, panel_count
from gpom_core.special import exp_neg

_Floats = NDArray[np.float64]
_Integers = NDArray[np.int64]


class Kind(IntEnum):
    """What an observation's shape is."""

    POINT = 0
    SEGMENT = 1
    BOX = 2


_BOX: Final = int(Kind.BOX)
_POINT: Final = int(Kind.POINT)
_BLOCK: Final = 512  # query points handled together, so that tables stay in the cache


def gram(kinds: ArrayLike, geometry: ArrayLike, length_scale: ArrayLike) -> _Floats:
    """Kernel between all pairs of shapes.

    Args:
        kinds: (n,) values of `Kind`.
        geometry: (n, 2, d), metres.
        length_scale: metres, one for all axes or (d,).

    Returns:
        (n, n), symmetric.

    Raises:
        ValueError: shapes do not fit together, or values are not finite or not positive.
    """
    checked_kinds, checked_geometry, inverse = _check(kinds, geometry, length_scale)
    out = np.empty((checked_kinds.size, checked_kinds.size))
    gram_into(checked_kinds, checked_geometry, inverse, out)
    return out


def cross(
    kinds: ArrayLike, geometry: ArrayLike, points: ArrayLike, length_scale: ArrayLike
) -> _Floats:
    """Kernel between m query points and n shapes.

    Args:
        kinds: (n,) values of `Kind`.
        geometry: (n, 2, d), metres.
        points: (m, d), metres.
        length_scale: metres, one for all axes or (d,).

    Returns:
        (m, n).

    Raises:
        ValueError: shapes do not fit together, or values are not finite or not positive.
    """
    checked_kinds, checked_geometry, inverse = _check(kinds, geometry, length_scale)
    checked_points = np.ascontiguousarray(points, dtype=np.float64)
    if checked_points.ndim != 2 or checked_points.shape[1] != checked_geometry.shape[2]:
        raise ValueError(
            f"points must have shape (m, {checked_geometry.shape[2]}) to go with the geometry, "
            f"got {checked_points.shape}"
        )
    if not np.isfinite(checked_points).all():
        raise ValueError("points must be finite")
    out = np.empty((len(checked_points), checked_kinds.size))
    cross_into(checked_kinds, checked_geometry, checked_points, inverse, out)
    return out


def prior_variance_of(kinds: ArrayLike, geometry: ArrayLike, length_scale: ArrayLike) -> _Floats:
    """Kernel of each shape with itself: the diagonal of `gram`, without the rest.

    Args, Raises: as `gram`.

    Returns:
        (n,), 1 for points and less for anything larger.
    """
    checked_kinds, checked_geometry, inverse = _check(kinds, geometry, length_scale)
    out = np.empty(checked_kinds.size)
    prior_variance_into(checked_kinds, checked_geometry, inverse, out)
    return out


def _check(
    kinds: ArrayLike, geometry: ArrayLike, length_scale: ArrayLike
) -> tuple[NDArray[np.uint8], _Floats, _Floats]:
    """Arguments as the compiled functions need them; the length scale inverted, (d,)."""
    shapes = np.ascontiguousarray(geometry, dtype=np.float64)
    if shapes.ndim != 3 or shapes.shape[1] != 2 or shapes.shape[2] == 0:
        raise ValueError(f"geometry must have shape (n, 2, d) with d >= 1, got {shapes.shape}")
    if not np.isfinite(shapes).all():
        raise ValueError("geometry must be finite")
    n, _, d = shapes.shape
    raw_kinds = np.asarray(kinds)
    if raw_kinds.shape != (n,):
        raise ValueError(f"kinds must have shape ({n},) as geometry has, got {raw_kinds.shape}")
    if not np.isin(raw_kinds, [int(kind) for kind in Kind]).all():
        raise ValueError(f"kinds must be values of Kind, got {np.unique(raw_kinds).tolist()}")
    checked_kinds = np.ascontiguousarray(raw_kinds, dtype=np.uint8)
    boxes = shapes[checked_kinds == _BOX]
    if (boxes[:, 1] < boxes[:, 0]).any():
        raise ValueError("a box must have its low corner first: geometry[i, 0] <= geometry[i, 1]")
    points = shapes[checked_kinds == _POINT]
    if (points[:, 1] != points[:, 0]).any():
        raise ValueError("a point must be given twice: geometry[i, 0] == geometry[i, 1]")
    scale = np.asarray(length_scale, dtype=np.float64)
    if scale.shape not in ((), (d,)):
        raise ValueError(f"length_scale must be one number or ({d},), got shape {scale.shape}")
    if not (np.isfinite(scale).all() and (scale > 0.0).all()):
        raise ValueError(f"length_scale must be finite and positive, got {scale.tolist()}")
    return checked_kinds, shapes, np.full(d, 1.0 / scale)


@compiled
def point_point(shape: _Floats, point: _Floats, inverse_length_scale: _Floats) -> float:
    """Kernel of a point, given as its geometry row (2, d), and a query point (d,)."""
    r2 = 0.0
    for axis in range(point.size):
        offset = (point[axis] - shape[0, axis]) * inverse_length_scale[axis]
        r2 += offset * offset
    return exp_neg(-0.5 * r2)


@compiled
def point_segment(shape: _Floats, point: _Floats, inverse_length_scale: _Floats) -> float:
    """Average over a segment, given as its geometry row (2, d), at a query point (d,)."""
    along = 0.0
    length2 = 0.0
    squared = 0.0
    for axis in range(point.size):
        scale = inverse_length_scale[axis]
        offset = (point[axis] - shape[0, axis]) * scale
        span = (shape[1, axis] - shape[0, axis]) * scale
        along += offset * span
        length2 += span * span
        squared += offset * offset
    if length2 == 0.0:
        return exp_neg(-0.5 * squared)
    length = np.sqrt(length2)
    s = along / length
    return exp_neg(-0.5 * (squared - s * s)) * interval_average(s, length)


@compiled
def point_box(shape: _Floats, point: _Floats, inverse_length_scale: _Floats) -> float:
    """Average over a box, given as its geometry row (2, d), at a query point (d,)."""
    product = 1.0
    for axis in range(point.size):
        scale = inverse_length_scale[axis]
        offset = (point[axis] - shape[0, axis]) * scale
        product *= interval_average(offset, (shape[1, axis] - shape[0, axis]) * scale)
    return product


@compiled
def gram_into(
    kinds: NDArray[np.uint8], geometry: _Floats, inverse_length_scale: _Floats, out: _Floats
) -> None:
    """`gram`, written into out (n, n); inverse_length_scale is (d,)."""
    lines = np.flatnonzero(kinds != _BOX)
    start, span = _whitened(geometry, lines, inverse_length_scale)
    if lines.size > 0:
        values = line_gram(start, span)
        for i in range(lines.size):
            for j in range(lines.size):
                out[lines[i], lines[j]] = values[i, j]
    boxes = np.flatnonzero(kinds == _BOX)
    if boxes.size == 0:
        return
    low, width = _whitened(geometry, boxes, inverse_length_scale)
    interval, interval_low, interval_width, interval_count = _distinct_intervals(low, width)
    _box_gram(boxes, interval, interval_low, interval_width, interval_count, out)
    if lines.size > 0:
        node, weight, first = _line_nodes(start, span)
        values = np.empty((boxes.size, first[-1]))
        _box_rows(interval, interval_low, interval_width, interval_count, node, values)
        for b in range(boxes.size):
            for j in range(lines.size):
                total = 0.0
                for q in range(first[j], first[j + 1]):
                    total += weight[q] * values[b, q]
                out[boxes[b], lines[j]] = total
                out[lines[j], boxes[b]] = total


@compiled
def cross_into(
    kinds: NDArray[np.uint8],
    geometry: _Floats,
    points: _Floats,
    inverse_length_scale: _Floats,
    out: _Floats,
) -> None:
    """`cross`, written into out (m, n); inverse_length_scale is (d,)."""
    m, d = points.shape
    lines = np.flatnonzero(kinds != _BOX)
    start, span = _whitened(geometry, lines, inverse_length_scale)
    boxes = np.flatnonzero(kinds == _BOX)
    low, width = _whitened(geometry, boxes, inverse_length_scale)
    interval, interval_low, interval_width, interval_count = _distinct_intervals(low, width)
    for begin in range(0, m, _BLOCK):
        size = min(_BLOCK, m - begin)
        whitened = np.empty((d, size))
        for axis in range(d):
            for k in range(size):
                whitened[axis, k] = points[begin + k, axis] * inverse_length_scale[axis]
        _line_cross(start, span, whitened, lines, begin, out)
        if boxes.size > 0:
            values = np.empty((boxes.size, size))
            _box_rows(interval, interval_low, interval_width, interval_count, whitened, values)
            for k in range(size):
                for b in range(boxes.size):
                    out[begin + k, boxes[b]] = values[b, k]


@compiled
def prior_variance_into(
    kinds: NDArray[np.uint8], geometry: _Floats, inverse_length_scale: _Floats, out: _Floats
) -> None:
    """`prior_variance_of`, written into out (n,); inverse_length_scale is (d,)."""
    n, _, d = geometry.shape
    for i in range(n):
        length2 = 0.0
        product = 1.0
        for axis in range(d):
            width = (geometry[i, 1, axis] - geometry[i, 0, axis]) * inverse_length_scale[axis]
            length2 += width * width
            if kinds[i] == _BOX:
                product *= _interval_variance(width)
        out[i] = product if kinds[i] == _BOX else _interval_variance(np.sqrt(length2))


@compiled
def _line_cross(
    start: _Floats, span: _Floats, points: _Floats, columns: _Integers, begin: int, out: _Floats
) -> None:
    """Kernel between lines and points (d, m), into rows of out from begin on."""
    d, m = points.shape
    s = np.empty(m)
    r2 = np.empty(m)
    value = np.empty(m)
    for i in range(columns.size):
        length = np.sqrt(np.sum(span[:, i] * span[:, i]))
        s[:] = 0.0
        r2[:] = 0.0
        for axis in range(d):
            t = span[axis, i] / length if length > 0.0 else 0.0
            for k in range(m):
                offset = points[axis, k] - start[axis, i]
                s[k] += offset * t
                r2[k] += offset * offset
        for k in range(m):
            r2[k] -= s[k] * s[k]
        line_averages(s, r2, length, value)
        for k in range(m):
            out[begin + k, columns[i]] = value[k]


@compiled
def _interval_variance(length: float) -> float:
    """Average of the kernel between two points of one interval."""
    total = 0.0
    size = panel_count(length) * node_count(length)
    node = np.empty(size)
    weight = np.empty(size)
    for q in range(fill_rule(length, node, weight)):
        total += weight[q] * interval_average(node[q] * length, length)
    return total


@compiled
def _whitened(
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
def _line_nodes(start: _Floats, span: _Floats) -> tuple[_Floats, _Floats, _Integers]:
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
def _distinct_intervals(
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


@compiled
def _box_gram(
    boxes: _Integers,
    interval: _Integers,
    interval_low: _Floats,
    interval_width: _Floats,
    interval_count: _Integers,
    out: _Floats,
) -> None:
    """Kernel between boxes, as a product over axes of values looked up per pair of intervals."""
    d, n = interval.shape
    for axis in range(d):
        used = interval_count[axis]
        table = line_gram(
            interval_low[axis : axis + 1, :used], interval_width[axis : axis + 1, :used]
        )
        for i in range(n):
            row = table[interval[axis, i]]
            for j in range(n):
                value = row[interval[axis, j]]
                if axis > 0:
                    value *= out[boxes[i], boxes[j]]
                out[boxes[i], boxes[j]] = value


@compiled
def _box_rows(
    interval: _Integers,
    interval_low: _Floats,
    interval_width: _Floats,
    interval_count: _Integers,
    points: _Floats,
    out: _Floats,
) -> None:
    """Kernel between n boxes and m points (d, m), into out (n, m)."""
    d, n = interval.shape
    m = points.shape[1]
    offset = np.empty(m)
    for axis in range(d):
        table = np.empty((interval_count[axis], m))
        for u in range(interval_count[axis]):
            for k in range(m):
                offset[k] = points[axis, k] - interval_low[axis, u]
            interval_averages(offset, interval_width[axis, u], table[u])
        for i in range(n):
            row = table[interval[axis, i]]
            if axis == 0:
                out[i] = row
            else:
                for k in range(m):
                    out[i, k] *= row[k]
