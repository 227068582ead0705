"""Integral kernels computed slowly: to 30 digits with mpmath, and by the paper's Simpson rule.

Whitened: the length scale is 1. A shape is its kind and its geometry row (2, d).
"""

from collections.abc import Callable

import mpmath as mp
import numpy as np
from numpy.typing import NDArray

from gpom_core.shapes import Kind

DIGITS = 30
Shape = tuple[Kind, NDArray[np.float64]]


def to_30_digits(first: Shape, second: Shape) -> float:
    """Average of the kernel over both shapes: one integral closed, the other by quadrature."""
    with mp.workdps(DIGITS):
        if first[0] == Kind.BOX and second[0] == Kind.BOX:
            axes = zip(first[1].T.tolist(), second[1].T.tolist(), strict=True)
            return float(mp.fprod(_between_intervals(a, b) for a, b in axes))
        if first[0] == Kind.BOX:
            first, second = second, first
        at_point = _box_at if second[0] == Kind.BOX else _line_at
        return float(_along(first[1], lambda x: at_point(second[1], x)))


def simpson(first: Shape, second: Shape, panels: int = 200) -> float:
    """The same between segments or points, by the composite Simpson rule over both."""
    share = np.linspace(0.0, 1.0, 2 * panels + 1)
    weight = np.ones_like(share)
    weight[1:-1:2] = 4.0
    weight[2:-1:2] = 2.0
    weight /= weight.sum()
    x, y = (row[0] + share[:, None] * (row[1] - row[0]) for _, row in (first, second))
    kernel = np.exp(-0.5 * ((x[:, None] - y) ** 2).sum(axis=-1))
    return float(weight @ kernel @ weight)


def _along(line: NDArray[np.float64], value: Callable[[list[mp.mpf]], mp.mpf]) -> mp.mpf:
    start = [mp.mpf(x) for x in line[0].tolist()]
    span = [mp.mpf(x) - a for x, a in zip(line[1].tolist(), start, strict=True)]
    length = mp.sqrt(sum(x * x for x in span))
    if length == 0:
        return value(start)
    ends = mp.linspace(0, 1, 2 + int(length / 3))
    return mp.quad(
        lambda u: value([a + u * x for a, x in zip(start, span, strict=True)]),
        ends,
        method="gauss-legendre",
        maxdegree=5,
    )


def _line_at(line: NDArray[np.float64], x: list[mp.mpf]) -> mp.mpf:
    offset = [p - mp.mpf(a) for p, a in zip(x, line[0].tolist(), strict=True)]
    span = [mp.mpf(b) - mp.mpf(a) for a, b in line.T.tolist()]
    length = mp.sqrt(sum(e * e for e in span))
    squared = sum(o * o for o in offset)
    if length == 0:
        return mp.exp(-squared / 2)
    s = sum(o * e for o, e in zip(offset, span, strict=True)) / length
    return mp.exp(-(squared - s * s) / 2) * _interval_at(s, length)


def _box_at(box: NDArray[np.float64], x: list[mp.mpf]) -> mp.mpf:
    sides = zip(x, box.T.tolist(), strict=True)
    return mp.fprod(_interval_at(p - mp.mpf(a), mp.mpf(b) - mp.mpf(a)) for p, (a, b) in sides)


def _between_intervals(first: list[float], second: list[float]) -> mp.mpf:
    low, high = (mp.mpf(x) for x in second)
    line = np.array(first)[:, None]
    return _along(line, lambda x: _interval_at(x[0] - low, high - low))


def _interval_at(s: mp.mpf, length: mp.mpf) -> mp.mpf:
    if length == 0:
        return mp.exp(-s * s / 2)
    reach = mp.erf((length - s) / mp.sqrt(2)) + mp.erf(s / mp.sqrt(2))
    return mp.sqrt(mp.pi / 2) / length * reach
