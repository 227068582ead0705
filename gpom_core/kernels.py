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

from typing import Final

import numpy as np
from numpy.typing import ArrayLike, NDArray

from gpom_core.averages import (
    interval_average,
    interval_variance,
    line_averages,
    line_gram,
    point_gram,
    point_gram_upper,
)
from gpom_core.boxes import (
    BoxSides,
    box_columns,
    box_gram,
    box_gram_upper,
    box_rows,
    box_sides,
)
from gpom_core.jit import compiled, vectorised
from gpom_core.layout import line_nodes, whitened
from gpom_core.shapes import Kind, checked, fault_of, refuse, typed
from gpom_core.special import exp_neg

_Floats = NDArray[np.float64]
_Integers = NDArray[np.integer]


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
        ValueError: what is passed does not fit together, is not finite, or is no such shape.
    """
    checked_kinds, checked_geometry, inverse = typed(kinds, geometry, length_scale)
    out = np.empty((checked_kinds.size, checked_kinds.size))
    refuse(_gram_or_fault(checked_kinds, checked_geometry, inverse, out))
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
        ValueError: what is passed does not fit together, is not finite, or is no such shape.
    """
    checked_kinds, checked_geometry, inverse = checked(kinds, geometry, length_scale)
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
    checked_kinds, checked_geometry, inverse = checked(kinds, geometry, length_scale)
    out = np.empty(checked_kinds.size)
    prior_variance_into(checked_kinds, checked_geometry, inverse, out)
    return out


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
    r2 = squared - s * s
    return exp_neg(-0.5 * (r2 if r2 > 0.0 else 0.0)) * interval_average(s, length)


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
    lines = np.flatnonzero(kinds != _BOX)
    boxes = np.flatnonzero(kinds == _BOX)
    size = lines.size
    in_order = size == 0 or lines[size - 1] == size - 1
    # Lines first, then boxes: then all loops are over neighbours.
    ordered = out if in_order else np.empty(out.shape)
    start, span = whitened(geometry, lines, inverse_length_scale)
    if span.any():
        line_gram(start, span, ordered)
    else:
        point_gram(start, ordered)
    if boxes.size > 0:
        low, width = whitened(geometry, boxes, inverse_length_scale)
        sides = box_sides(low, width)
        box_gram(sides, size, ordered)
        values = _line_rows(sides, start, span)
        for b in range(boxes.size):
            for j in range(size):
                ordered[size + b, j] = values[b, j]
        for j in range(size):
            for b in range(boxes.size):
                ordered[j, size + b] = values[b, j]
    if not in_order:
        place = np.concatenate((lines, boxes))
        for i in range(place.size):
            for j in range(place.size):
                out[place[i], place[j]] = ordered[i, j]


@compiled
def gram_upper_into(
    kinds: NDArray[np.uint8], geometry: _Floats, inverse_length_scale: _Floats, out: _Floats
) -> int:
    """Upper triangle of `gram`, into the first n rows and columns of out; or a fault, see `refuse`.

    Fast where points come first and boxes then, in two dimensions: what a map is made of.
    """
    fault = fault_of(kinds, geometry, inverse_length_scale)
    if fault != 0:
        return fault
    n, points = len(kinds), 0
    while points < n and kinds[points] == _POINT:
        points += 1
    if geometry.shape[2] == 2 and (kinds[points:] == _BOX).all():
        start, _ = whitened(geometry, np.arange(points), inverse_length_scale)
        point_gram_upper(start, out)
        if points < n:
            low, width = whitened(geometry, np.arange(points, n), inverse_length_scale)
            sides = box_sides(low, width)
            box_columns(sides, start, points, out)
            box_gram_upper(sides, points, out)
        return 0
    dense = np.empty((n, n))
    gram_into(kinds, geometry, inverse_length_scale, dense)
    for i in range(n):
        for j in range(i, n):
            out[i, j] = dense[i, j]
    return 0


@compiled
def _gram_or_fault(
    kinds: NDArray[np.uint8], geometry: _Floats, inverse_length_scale: _Floats, out: _Floats
) -> int:
    fault = fault_of(kinds, geometry, inverse_length_scale)
    if fault == 0:
        gram_into(kinds, geometry, inverse_length_scale, out)
    return fault


@compiled
def _line_rows(sides: BoxSides, start: _Floats, span: _Floats) -> _Floats:
    """Kernel between b boxes and n lines (d, n), (b, n)."""
    out = np.empty((sides.side.shape[1], start.shape[1]))
    if not span.any():  # only points
        box_rows(sides, start, out)
        return out
    node, weight, first = line_nodes(start, span)
    begin = first.astype(np.uint64)  # unsigned indices: no test for wrapping round
    at_nodes = np.empty((len(out), weight.size))
    box_rows(sides, node, at_nodes)
    for b in range(len(out)):
        row = at_nodes[b]
        for j in range(out.shape[1]):
            total = 0.0
            for q in range(begin[j], begin[j + 1]):
                total += weight[q] * row[q]
            out[b, j] = total
    return out


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
    boxes = np.flatnonzero(kinds == _BOX)
    start, span = whitened(geometry, lines, inverse_length_scale)
    low, width = whitened(geometry, boxes, inverse_length_scale)
    sides = box_sides(low, width)
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
            box_rows(sides, block, values)
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
                product *= interval_variance(width)
        out[i] = product if kinds[i] == _BOX else interval_variance(np.sqrt(length2))


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
