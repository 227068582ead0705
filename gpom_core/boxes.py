"""Kernels of axis-aligned boxes, from tables of one-dimensional values.

A box kernel is a product over axes, and boxes of one lattice share their sides. So each distinct
side is integrated once per axis, and of pairs of sides each distinct pair: how wide they are and
how far apart. A row of pairs of boxes is then a product of two rows of such values. Boxes that
share nothing cost little more than without tables. Everything is whitened.
"""

from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from gpom_core.averages import CUTOFF, interval_averages
from gpom_core.jit import compiled
from gpom_core.layout import distinct_intervals
from gpom_core.quadrature import fill_rule, rule_size

_Floats = NDArray[np.float64]
_Integers = NDArray[np.int64]

_SAME: Final = 1e-11  # length scales; rounding tells equal lengths of a lattice apart
_SLOTS: Final = 256
_SLOTS_PER_LENGTH: Final = 16.0


class BoxSides(NamedTuple):
    """Distinct sides of n boxes in d dimensions.

    Attributes:
        side: (d, n) which side a box has. used: (d,) number of sides.
        low, width: (d, n) of the sides, of which the first `used` count.
        kind: (d, n) number of each side's width. widths: (w,) all there are, longest first.
    """

    side: _Integers
    used: _Integers
    low: _Floats
    width: _Floats
    kind: _Integers
    widths: _Floats


@compiled
def box_sides(low: _Floats, width: _Floats) -> BoxSides:
    """The distinct sides of n boxes, given by low corners and widths (d, n)."""
    side, side_low, side_width, used = distinct_intervals(low, width)
    d, n = low.shape
    kind, widths = np.empty((d, n), np.int64), np.empty(d * n)
    found = 0
    for axis in range(d):
        for u in range(used[axis]):
            w = 0
            while w < found and abs(widths[w] - side_width[axis, u]) > _SAME:
                w += 1
            if w == found:
                widths[w] = side_width[axis, u]
                found += 1
            kind[axis, u] = w
    order = np.argsort(-widths[:found])
    rank = np.empty(found, np.int64)
    for w in range(found):
        rank[order[w]] = w
    for axis in range(d):
        for u in range(used[axis]):
            kind[axis, u] = rank[kind[axis, u]]
    return BoxSides(side, used, side_low, side_width, kind, widths[order])


@compiled
def box_gram(sides: BoxSides, first: int, out: _Floats) -> None:
    """Kernel between all pairs of n boxes, into n rows and columns of out from `first` on."""
    _multiply(_pair_tables(sides), sides.side, first, out)


@compiled
def box_gram_upper(sides: BoxSides, first: int, out: _Floats) -> None:
    """As `box_gram`, in two dimensions and the upper triangle alone."""
    tables, side = _pair_tables(sides), sides.side
    n = side.shape[1]
    for i in range(n):
        x, y = tables[0, side[0, i], i:], tables[1, side[1, i], i:]
        row = out[first + i, first + i : first + n]
        for j in range(n - i):
            row[j] = x[j] * y[j]


@compiled
def _pair_tables(sides: BoxSides) -> _Floats:
    """Kernel between each side of each axis and all n boxes' sides, (d, sides, n)."""
    d, n = sides.side.shape
    pair, value = _side_gram(sides)
    tables = np.empty((d, sides.used.max(), n))
    for axis in range(d):
        for u in range(sides.used[axis]):
            numbers, row = pair[axis, u], tables[axis, u]
            for j in range(n):
                row[j] = value[numbers[sides.side[axis, j]]]
    return tables


@compiled
def box_rows(sides: BoxSides, points: _Floats, out: _Floats) -> None:
    """Kernel between n boxes and m points (d, m), into out (n, m)."""
    _multiply(_point_tables(sides, points), sides.side, 0, out)


@compiled
def box_columns(sides: BoxSides, points: _Floats, first: int, out: _Floats) -> None:
    """As `box_rows`, in two dimensions, into columns from `first` on of out's first m rows."""
    tables, side = _point_tables(sides, points), sides.side
    m = points.shape[1]
    for j in range(side.shape[1]):
        x, y = tables[0, side[0, j]], tables[1, side[1, j]]
        for k in range(m):
            out[k, first + j] = x[k] * y[k]


@compiled
def _point_tables(sides: BoxSides, points: _Floats) -> _Floats:
    """Kernel between each side of each axis and m points (d, m), (d, sides, m)."""
    d, m = points.shape
    most = sides.used.max()
    tables = np.empty((d, most, m))
    offset, value = np.empty(most * m), np.empty(most * m)
    for axis in range(d):
        for w in range(len(sides.widths)):  # all sides of one width in one pass
            filled = 0
            for u in range(sides.used[axis]):
                if sides.kind[axis, u] == w:
                    low = sides.low[axis, u]
                    for k in range(m):
                        offset[filled + k] = points[axis, k] - low
                    filled += m
            interval_averages(offset[:filled], sides.widths[w], value)
            filled = 0
            for u in range(sides.used[axis]):
                if sides.kind[axis, u] == w:
                    tables[axis, u] = value[filled : filled + m]
                    filled += m
    return tables


@compiled
def _multiply(tables: _Floats, side: _Integers, first: int, out: _Floats) -> None:
    """Row i, from column `first` on, of out[first:]: the product of rows side[:, i] of tables."""
    d, _, m = tables.shape
    for i in range(side.shape[1]):
        row, x = out[first + i, first : first + m], tables[0, side[0, i]]
        if d == 2:
            y = tables[1, side[1, i]]
            for j in range(m):
                row[j] = x[j] * y[j]
            continue
        for j in range(m):
            row[j] = x[j]
        for axis in range(1, d):
            values = tables[axis, side[axis, i]]
            for j in range(m):
                row[j] *= values[j]


@compiled
def _side_gram(sides: BoxSides) -> tuple[_Integers, _Floats]:
    """Kernel between all pairs of sides of each axis.

    Returns:
        For each axis and two sides the number of a value; the values, of which the first is 0.
    """
    d, most = len(sides.used), sides.used.max()
    pair = np.zeros((d, most, most), np.int64)
    room = 1
    for axis in range(d):
        room += sides.used[axis] * (sides.used[axis] + 1) // 2
    longer, shorter = np.empty(room, np.int64), np.empty(room, np.int64)
    apart = np.empty(room)
    slots = np.zeros(_SLOTS, np.int64)
    size = 1
    for axis in range(d):
        kind, low, width = sides.kind[axis], sides.low[axis], sides.width[axis]
        for i in range(sides.used[axis]):
            for j in range(i + 1):
                a, b = min(kind[i], kind[j]), max(kind[i], kind[j])
                between = abs(low[i] - low[j] + 0.5 * (width[i] - width[j]))
                if between - 0.5 * (width[i] + width[j]) > CUTOFF:
                    continue
                slot = (int(between * _SLOTS_PER_LENGTH + 0.5) + 37 * a + 101 * b) % _SLOTS
                at = slots[slot]
                # Two that share a slot drive each other out: some values are computed twice.
                if (
                    at == 0 or longer[at] != a or shorter[at] != b
                    or abs(apart[at] - between) > _SAME
                ):  # fmt: skip
                    longer[size], shorter[size], apart[size] = a, b, between
                    at = size
                    slots[slot] = size
                    size += 1
                pair[axis, i, j] = at
                pair[axis, j, i] = at
    return pair, _pair_values(longer[:size], shorter[:size], apart[:size], sides.widths)


@compiled
def _pair_values(longer: _Integers, shorter: _Integers, apart: _Floats, widths: _Floats) -> _Floats:
    """Kernel between intervals of two widths whose middles are `apart`; the first value is 0.

    The longer is integrated in closed form, the shorter by Gauss-Legendre.
    """
    first, node, weight = _rules(widths)
    order, begin = _grouped(longer, len(widths))
    room = 0
    for t in order:
        room += first[shorter[t] + 1] - first[shorter[t]]
    s, value, out = np.empty(room), np.empty(room), np.zeros(len(apart))
    for a in range(len(widths)):  # all pairs with one longer width in one pass
        pairs, filled = order[begin[a] : begin[a + 1]], 0
        for t in pairs:
            b = shorter[t]
            start = apart[t] + 0.5 * (widths[a] - widths[b])
            for q in range(first[b], first[b + 1]):
                s[filled] = start + widths[b] * node[q]
                filled += 1
        interval_averages(s[:filled], widths[a], value)
        filled = 0
        for t in pairs:
            for q in range(first[shorter[t]], first[shorter[t] + 1]):
                out[t] += weight[q] * value[filled]
                filled += 1
    return out


@compiled
def _grouped(key: _Integers, keys: int) -> tuple[_Integers, _Integers]:
    """Numbers 1, 2, ... of the elements but the first, sorted by key; where each key begins."""
    begin = np.zeros(keys + 1, np.int64)
    for t in range(1, len(key)):
        begin[key[t] + 1] += 1
    for k in range(keys):
        begin[k + 1] += begin[k]
    order, filled = np.empty(len(key) - 1, np.int64), begin[:-1].copy()
    for t in range(1, len(key)):
        order[filled[key[t]]] = t
        filled[key[t]] += 1
    return order, begin


@compiled
def _rules(widths: _Floats) -> tuple[_Integers, _Floats, _Floats]:
    """Where the quadrature rule of each width begins, (w + 1,); nodes in [0, 1] and weights."""
    count = len(widths)
    first = np.zeros(count + 1, np.int64)
    for w in range(count):
        first[w + 1] = first[w] + rule_size(widths[w])
    node, weight = np.empty(first[count]), np.empty(first[count])
    for w in range(count):
        fill_rule(widths[w], node[first[w] :], weight[first[w] :])
    return first, node, weight
