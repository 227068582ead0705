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

from gpom_core.averages import interval_average, line_averages, line_gram
from gpom_core.boxes import box_gram, box_rows
from gpom_core.jit import compiled, vectorised
from gpom_core.quadrature import fill_rule, rule_size
from gpom_core.special import exp_neg

_Floats = NDArray[np.float64]
_Integers = NDArray[np.integer]


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


@vectorised
def point_point(shape: _Floats, point: _Floats, inverse_length_scale: _Floats) -> float:
    """Kernel of a point, given as its geometry row (2, d), and a query point (d,)."""
    if point.size == 2:  # spelled out: a loop over two axes takes three times as long
        x = (point[0] - shape[0, 0]) * inverse_length_scale[0]
        y = (point[1] - shape[0, 1]) * inverse_length_scale[1]
        return exp_neg(-0.5 * (x * x + y * y))
    r2 = 0.0
    for axis in range(point.size):
        offset = (point[axis] - shape[0, axis]) * inverse_length_scale[axis]
        r2 += offset * offset
    return exp_neg(-0.5 * r2)


@vectorised
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
    length = np.sqrt(length2)
    s = along / length if length > 0.0 else 0.0
    return exp_neg(-0.5 * (squared - s * s)) * interval_average(s, length)


@vectorised
def point_box(shape: _Floats, point: _Floats, inverse_length_scale: _Floats) -> float:
    """Average over a box, given as its geometry row (2, d), at a query point (d,)."""
    if point.size == 2:
        return _side_average(shape, point, inverse_length_scale, 0) * _side_average(
            shape, point, inverse_length_scale, 1
        )
    product = 1.0
    for axis in range(point.size):
        product *= _side_average(shape, point, inverse_length_scale, axis)
    return product


@vectorised
def _side_average(
    shape: _Floats, point: _Floats, inverse_length_scale: _Floats, axis: int
) -> float:
    low = (point[axis] - shape[0, axis]) * inverse_length_scale[axis]
    width = (shape[1, axis] - shape[0, axis]) * inverse_length_scale[axis]
    return interval_average(low, width)


@compiled
def gram_into(
    kinds: NDArray[np.uint8], geometry: _Floats, inverse_length_scale: _Floats, out: _Floats
) -> None:
    """`gram`, written into out (n, n); inverse_length_scale is (d,)."""
    lines = _of_kind(kinds, False)
    boxes = _of_kind(kinds, True)
    start, span = _whitened(geometry, lines, inverse_length_scale)
    line_gram(start, span, lines, out)
    if boxes.size == 0:
        return
    low, width = _whitened(geometry, boxes, inverse_length_scale)
    box_gram(low, width, boxes, out)
    if lines.size > 0:
        node, weight, first = _line_nodes(start, span)
        values = np.empty((boxes.size, weight.size))
        box_rows(low, width, node, values)
        for b in range(boxes.size):
            row = values[b]
            for j in range(np.uint64(lines.size)):
                total = 0.0
                for q in range(first[j], first[j + np.uint64(1)]):
                    total += weight[q] * row[q]
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
    lines = _of_kind(kinds, False)
    boxes = _of_kind(kinds, True)
    start, span = _whitened(geometry, lines, inverse_length_scale)
    low, width = _whitened(geometry, boxes, inverse_length_scale)
    for begin in range(0, m, _BLOCK):
        size = min(_BLOCK, m - begin)
        block = np.empty((d, size))
        for axis in range(d):
            for k in range(size):
                block[axis, k] = points[begin + k, axis] * inverse_length_scale[axis]
        rows = out[begin : begin + size]
        _line_cross(start, span, block, lines, rows)
        if boxes.size > 0:
            values = np.empty((boxes.size, size))
            box_rows(low, width, block, values)
            for k in range(size):
                for b in range(boxes.size):
                    rows[k, boxes[b]] = values[b, k]


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
def _interval_variance(length: float) -> float:
    """Average of the kernel between two points of one interval."""
    if length == 0.0:
        return 1.0
    size = rule_size(length)
    node = np.empty(size)
    weight = np.empty(size)
    fill_rule(length, node, weight)
    total = 0.0
    for q in range(size):
        total += weight[q] * interval_average(node[q] * length, length)
    return total


@compiled
def _of_kind(kinds: NDArray[np.uint8], boxes: bool) -> _Integers:
    """Indices of the boxes, or of all that are not: points and segments are lines."""
    chosen = np.empty(kinds.size, np.uint64)
    found = np.uint64(0)
    for i in range(kinds.size):
        if (kinds[i] == _BOX) == boxes:
            chosen[found] = i
            found += np.uint64(1)
    return chosen[:found].copy()


@compiled
def _whitened(
    geometry: _Floats, chosen: _Integers, inverse_length_scale: _Floats
) -> tuple[_Floats, _Floats]:
    """Starts and spans of the chosen shapes, each (d, n), in length scales."""
    d = geometry.shape[2]
    start = np.empty((d, chosen.size))
    span = np.empty((d, chosen.size))
    for axis in range(d):
        scale = inverse_length_scale[axis]
        for i in range(chosen.size):
            first = geometry[chosen[i], 0, axis]
            start[axis, i] = first * scale
            span[axis, i] = (geometry[chosen[i], 1, axis] - first) * scale
    return start, span


@compiled
def _line_nodes(start: _Floats, span: _Floats) -> tuple[_Floats, _Floats, _Integers]:
    """Quadrature nodes (d, N) and weights (N,) of n lines; line j owns first[j]:first[j + 1]."""
    d, n = start.shape
    first = np.zeros(n + 1, np.uint64)
    length = np.empty(n)
    for j in range(n):
        length2 = 0.0
        for axis in range(d):
            length2 += span[axis, j] * span[axis, j]
        length[j] = np.sqrt(length2)
        first[j + 1] = first[j] + np.uint64(rule_size(length[j]))
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
def _line_cross(
    start: _Floats, span: _Floats, points: _Floats, columns: _Integers, out: _Floats
) -> None:
    """Kernel between lines (d, n) and points (d, m), into the given columns of out."""
    d, m = points.shape
    s = np.empty(m)
    r2 = np.empty(m)
    value = np.empty(m)
    for i in range(columns.size):
        length2 = 0.0
        for axis in range(d):
            length2 += span[axis, i] * span[axis, i]
        length = np.sqrt(length2)
        s[:] = 0.0
        r2[:] = 0.0
        for axis in range(d):
            t = span[axis, i] / length if length > 0.0 else 0.0
            origin = start[axis, i]
            for k in range(m):
                offset = points[axis, k] - origin
                s[k] += offset * t
                r2[k] += offset * offset
        for k in range(m):
            r2[k] -= s[k] * s[k]
        line_averages(s, r2, length, value)
        column = columns[i]
        for k in range(m):
            out[k, column] = value[k]
