"""Averages of a unit Gaussian over lines: what every integral kernel is made of.

Everything is whitened: lengths are in length scales, the kernel is exp(-|x - x'|^2 / 2). A line
is a start and a span; a point is a line of span zero. A box separates into one line per axis, so
box kernels are products of these in one dimension.
"""

from typing import Final

import numpy as np
from numpy.typing import NDArray

from gpom_core.jit import compiled, vectorised
from gpom_core.quadrature import fill_rule, rule_size
from gpom_core.special import erf, exp_neg

_Floats = NDArray[np.float64]
_Integers = NDArray[np.integer]

_SQRT_HALF: Final = 0.7071067811865476
_SQRT_HALF_PI: Final = 1.2533141373155003

# Up to this length a series is cheaper than two error functions, and more accurate: the closed
# form divides the error of erf by the length.
_SHORT: Final = 0.45
_FAR: Final = 1500.0  # squared distance at which the kernel is zero and no power overflows

# Kernel values between shapes farther apart than this are below 1e-10 and left at zero.
CUTOFF: Final = 6.8

_TOGETHER: Final = 4096  # pairs of points in one pass, so that they stay in the cache


@vectorised
def _short_series(length: float) -> tuple[float, float, float, float, float]:
    """Coefficients a of sum_k a_k c^2k exp(-c^2 / 2), the average over an interval centred at -c.

    The Taylor series in the length, to its eighth power: the kernel's derivatives are Hermite
    polynomials times the kernel. The error is below 1e-11 up to length 0.45.
    """
    g = 0.25 * length * length
    g1, g2, g3, g4 = g / 6.0, g * g / 120.0, g * g * g / 5040.0, g * g * g * g / 362880.0
    return (
        1.0 - g1 + 3.0 * g2 - 15.0 * g3 + 105.0 * g4,
        g1 - 6.0 * g2 + 45.0 * g3 - 420.0 * g4,
        g2 - 15.0 * g3 + 210.0 * g4,
        g3 - 28.0 * g4,
        g4,
    )


@vectorised
def interval_average(s: float, length: float) -> float:
    """Average of exp(-(s - u)^2 / 2) over u in [0, length]."""
    if length > _SHORT:
        reach = erf((length - s) * _SQRT_HALF) + erf(s * _SQRT_HALF)
        return _SQRT_HALF_PI / length * reach
    a0, a1, a2, a3, a4 = _short_series(length)
    c = s - 0.5 * length
    c2 = c * c
    c2 = _FAR if c2 > _FAR else c2
    return exp_neg(-0.5 * c2) * (a0 + c2 * (a1 + c2 * (a2 + c2 * (a3 + c2 * a4))))


@compiled
def interval_variance(length: float) -> float:
    """Average of the kernel between two points of one interval.

    2 (I(L) - 1) / L^2 with I(z) = z sqrt(pi/2) erf(z / sqrt2) + exp(-z^2 / 2), or its series.
    """
    g = 0.5 * length * length
    if length > _SHORT:
        return (length * _SQRT_HALF_PI * erf(length * _SQRT_HALF) + exp_neg(-g) - 1.0) / g
    series = 1.0 - g * 5.0 / 28.0 * (1.0 - g * 7.0 / 45.0 * (1.0 - g * 3.0 / 22.0))
    return 1.0 - g / 6.0 * (1.0 - g / 5.0 * series)


@compiled
def interval_averages(s: _Floats, length: float, out: _Floats) -> None:
    """`interval_average` of every element of s."""
    if length > _SHORT:
        factor = _SQRT_HALF_PI / length
        for k in range(s.size):
            out[k] = factor * (erf((length - s[k]) * _SQRT_HALF) + erf(s[k] * _SQRT_HALF))
        return
    a0, a1, a2, a3, a4 = _short_series(length)
    for k in range(s.size):
        c = s[k] - 0.5 * length
        c2 = c * c
        c2 = _FAR if c2 > _FAR else c2
        out[k] = exp_neg(-0.5 * c2) * (a0 + c2 * (a1 + c2 * (a2 + c2 * (a3 + c2 * a4))))


@compiled
def line_averages(s: _Floats, r2: _Floats, length: float, out: _Floats) -> None:
    """Average over a line, at points s along it and at squared distance r2 from its axis.

    Equation 11 of the paper; a length of zero gives the point kernel. The arrays may have unused
    room in out.
    """
    if length == 0.0:
        for k in range(s.size):
            out[k] = exp_neg(-0.5 * r2[k])
        return
    interval_averages(s, length, out)
    for k in range(s.size):
        across = r2[k] if r2[k] > 0.0 else 0.0  # far along the axis rounding leaves anything
        out[k] *= exp_neg(-0.5 * across)


@compiled
def line_gram(start: _Floats, span: _Floats, out: _Floats) -> None:
    """Double averages between all pairs of n lines in d dimensions.

    Of each pair one line is integrated in closed form, the other by Gauss-Legendre: the one that
    needs fewer nodes. All nodes that one line meets are evaluated in one vectorised pass.

    Args:
        start: (d, n) start of each line.
        span: (d, n) end minus start.
        out: written are the first n rows of its first n columns.
    """
    # Indices are unsigned: numba tests signed ones for wrapping round, a quarter of the time.
    d, lines = start.shape
    n = np.uint64(lines)
    one = np.uint64(1)
    order, length, first = _by_nodes(span)
    points = np.uint64(lines)  # lines from here on are points
    while points > 0 and length[points - one] == 0.0:
        points -= one
    middle, e = np.empty((d, lines)), np.empty((d, lines))
    node, weight = np.empty(first[n]), np.empty(first[n])
    for i in range(n):
        for axis in range(d):
            e[axis, i] = span[axis, order[i]]
            middle[axis, i] = start[axis, order[i]] + 0.5 * e[axis, i]
        fill_rule(length[i], node[first[i] :], weight[first[i] :])
    along, squared, near = np.empty(lines), np.empty(lines), np.empty(lines, np.uint64)
    s, r2, value = np.empty(first[n]), np.empty(first[n]), np.empty(first[n])
    for i in range(n):
        half = 0.5 * length[i]
        # every later line's middle, as seen from the middle of this one
        for j in range(i, n):
            along[j] = 0.0
            squared[j] = 0.0
        for axis in range(d):
            t = e[axis, i] / length[i] if length[i] > 0.0 else 0.0
            origin = middle[axis, i]
            for j in range(i, n):
                offset = middle[axis, j] - origin
                along[j] += offset * t
                squared[j] += offset * offset
        # the nodes of the lines that are near enough, then the points
        filled = np.uint64(0)
        found = np.uint64(0)
        for j in range(i, points):
            s0, r0, length_j = along[j], squared[j], length[j]
            beyond = max(abs(s0) - half, 0.0)
            reach = CUTOFF + 0.5 * length_j
            if beyond * beyond + r0 - s0 * s0 > reach * reach:
                out[order[i], order[j]] = 0.0
                out[order[j], order[i]] = 0.0
                continue
            near[found] = j
            found += one
            slope = 0.0
            mixed = 0.0
            for axis in range(d):
                slope += e[axis, j] * e[axis, i]
                mixed += e[axis, j] * (middle[axis, j] - middle[axis, i])
            slope /= length[i]
            mixed *= 2.0
            length2 = length_j * length_j
            for q in range(first[j], first[j + one]):
                u = node[q] - 0.5
                along_u = s0 + u * slope
                s[filled] = along_u + half
                r2[filled] = r0 + u * (mixed + u * length2) - along_u * along_u
                filled += one
        rest = i if i > points else points
        for j in range(rest, n):
            s[filled] = along[j] + half
            r2[filled] = squared[j] - along[j] * along[j]
            filled += one
        line_averages(s[:filled], r2[:filled], length[i], value)
        filled = np.uint64(0)
        for k in range(found):
            j = near[k]
            total = 0.0
            for q in range(first[j], first[j + one]):
                total += weight[q] * value[filled]
                filled += one
            out[order[i], order[j]] = total
            out[order[j], order[i]] = total
        for j in range(rest, n):
            out[order[i], order[j]] = value[filled]
            out[order[j], order[i]] = value[filled]
            filled += one


@compiled
def point_gram(points: _Floats, out: _Floats) -> None:
    """`line_gram` of n points (d, n): nothing to integrate, many pairs in one vectorised pass."""
    d, n = points.shape
    r2 = np.empty(min(n * n, max(n, _TOGETHER)))
    begin, filled = 0, 0
    for i in range(n):
        for j in range(i, n):
            if d == 2:  # spelled out: a loop over two axes takes three times as long
                x, y = points[0, j] - points[0, i], points[1, j] - points[1, i]
                r2[filled] = x * x + y * y
            else:
                r2[filled] = 0.0
                for axis in range(d):
                    offset = points[axis, j] - points[axis, i]
                    r2[filled] += offset * offset
            filled += 1
        if i + 1 < n and filled + n <= r2.size:
            continue
        for k in range(filled):
            r2[k] = exp_neg(-0.5 * r2[k])
        filled = 0
        for row in range(begin, i + 1):
            for j in range(row, n):
                out[row, j] = r2[filled]
                out[j, row] = r2[filled]
                filled += 1
        begin, filled = i + 1, 0


@compiled
def point_gram_upper(points: _Floats, out: _Floats) -> None:
    """As `point_gram`, in two dimensions and the upper triangle alone."""
    n = points.shape[1]
    r2 = np.empty(n * (n + 1) // 2)
    filled = 0
    for i in range(n):
        x, y, row = points[0, i:], points[1, i:], r2[filled : filled + n - i]
        for j in range(n - i):
            dx, dy = x[j] - x[0], y[j] - y[0]
            row[j] = -0.5 * (dx * dx + dy * dy)
        filled += n - i
    for k in range(filled):
        r2[k] = exp_neg(r2[k])
    filled = 0
    for i in range(n):
        out[i, i:n] = r2[filled : filled + n - i]
        filled += n - i


@compiled
def _by_nodes(span: _Floats) -> tuple[_Integers, _Floats, _Integers]:
    """Lines (d, n) ordered by falling number of nodes, points last.

    Returns:
        The order (n,); the lengths in that order; where each line's nodes begin, (n + 1,).
    """
    d, n = span.shape
    unsorted_length = np.empty(n)
    size = np.empty(n, np.int64)
    most = 0
    for j in range(n):
        length2 = 0.0
        for axis in range(d):
            length2 += span[axis, j] * span[axis, j]
        unsorted_length[j] = np.sqrt(length2)
        size[j] = rule_size(unsorted_length[j]) if length2 > 0.0 else 0
        most = max(most, size[j])
    order = np.empty(n, np.uint64)
    length = np.empty(n)
    first = np.zeros(n + 1, np.uint64)
    i = np.uint64(0)
    for wanted in range(most, -1, -1):
        for j in range(n):
            if size[j] == wanted:
                order[i] = j
                length[i] = unsorted_length[j]
                first[i + np.uint64(1)] = first[i] + np.uint64(max(wanted, 1))
                i += np.uint64(1)
    return order, length, first
