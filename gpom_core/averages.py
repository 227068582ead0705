"""Averages of a unit Gaussian over lines: what every integral kernel is made of.

Everything is whitened: lengths are in length scales, the kernel is exp(-|x - x'|^2 / 2). A line
is a start and a span; a point is a line of span zero. A box separates into one line per axis, so
box kernels are products of these in one dimension.
"""

from typing import Final

import numpy as np
from numpy.typing import NDArray

from gpom_core.jit import compiled
from gpom_core.quadrature import fill_rule, node_count, panel_count
from gpom_core.special import erf, exp_neg

_SQRT_HALF: Final = 0.7071067811865476
_SQRT_HALF_PI: Final = 1.2533141373155003

# Up to this length a series is cheaper than two error functions, and more accurate: the closed
# form divides the error of erf by the length.
_SHORT: Final = 0.45

# Kernel values between shapes farther apart than this are below 1e-10 and left at zero.
CUTOFF: Final = 6.8


@compiled
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


@compiled
def interval_average(s: float, length: float) -> float:
    """Average of exp(-(s - u)^2 / 2) over u in [0, length]."""
    if length > _SHORT:
        reach = erf((length - s) * _SQRT_HALF) + erf(s * _SQRT_HALF)
        return _SQRT_HALF_PI / length * reach
    a0, a1, a2, a3, a4 = _short_series(length)
    c = s - 0.5 * length
    c2 = c * c
    return exp_neg(-0.5 * c2) * (a0 + c2 * (a1 + c2 * (a2 + c2 * (a3 + c2 * a4))))


@compiled
def interval_averages(s: NDArray[np.float64], length: float, out: NDArray[np.float64]) -> None:
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
        out[k] = exp_neg(-0.5 * c2) * (a0 + c2 * (a1 + c2 * (a2 + c2 * (a3 + c2 * a4))))


@compiled
def line_averages(
    s: NDArray[np.float64], r2: NDArray[np.float64], length: float, out: NDArray[np.float64]
) -> None:
    """Average over a line, at points s along it and at squared distance r2 from its axis.

    Equation 11 of the paper; a length of zero gives the point kernel.
    """
    if length == 0.0:
        for k in range(s.size):
            out[k] = exp_neg(-0.5 * r2[k])
        return
    interval_averages(s, length, out)
    for k in range(s.size):
        out[k] *= exp_neg(-0.5 * r2[k])


@compiled
def line_gram(start: NDArray[np.float64], span: NDArray[np.float64]) -> NDArray[np.float64]:
    """Double averages between all pairs of n lines in d dimensions.

    Of each pair the longer line is integrated in closed form, the shorter by Gauss-Legendre.

    Args:
        start: (d, n) start of each line.
        span: (d, n) end minus start.

    Returns:
        (n, n), symmetric.
    """
    d, n = start.shape
    out = np.zeros((n, n))
    length = np.zeros(n)
    total_nodes = 0
    count = np.empty(n, np.int64)
    for j in range(n):
        length[j] = np.sqrt(np.sum(span[:, j] * span[:, j]))
        count[j] = panel_count(length[j]) * node_count(length[j])
        total_nodes += count[j]
    first = np.empty(n, np.int64)
    node = np.empty(total_nodes)
    weight = np.empty(total_nodes)
    filled = 0
    for j in range(n):
        first[j] = filled
        filled += fill_rule(length[j], node[filled:], weight[filled:])

    s = np.empty(total_nodes)
    r2 = np.empty(total_nodes)
    value = np.empty(total_nodes)
    along = np.empty(n)
    along_span = np.empty(n)
    squared = np.empty(n)
    mixed = np.empty(n)
    gap2 = np.empty(n)
    near = np.empty(n, np.int64)
    for i in range(n):
        along[:] = 0.0
        along_span[:] = 0.0
        squared[:] = 0.0
        mixed[:] = 0.0
        gap2[:] = 0.0
        for axis in range(d):
            a = start[axis, i]
            e = span[axis, i]
            t = e / length[i] if length[i] > 0.0 else 0.0
            low = min(a, a + e)
            high = max(a, a + e)
            for j in range(n):
                p = start[axis, j] - a
                f = span[axis, j]
                along[j] += p * t
                along_span[j] += f * t
                squared[j] += p * p
                mixed[j] += p * f
                b = start[axis, j]
                gap = max(low - max(b, b + f), min(b, b + f) - high)
                gap = gap if gap > 0.0 else 0.0
                gap2[j] += gap * gap
        # the shorter lines (of equals, the later) that are near enough, as one run of nodes
        found = 0
        filled = 0
        for j in range(n):
            if gap2[j] > CUTOFF * CUTOFF or length[j] > length[i]:
                continue
            if length[j] == length[i] and j < i:
                continue
            near[found] = j
            found += 1
            length2 = length[j] * length[j]
            for q in range(first[j], first[j] + count[j]):
                u = node[q]
                along_u = along[j] + u * along_span[j]
                s[filled] = along_u
                r2[filled] = squared[j] + u * (2.0 * mixed[j] + u * length2) - along_u * along_u
                filled += 1
        line_averages(s[:filled], r2[:filled], length[i], value)
        filled = 0
        for k in range(found):
            j = near[k]
            total = 0.0
            for q in range(count[j]):
                total += weight[first[j] + q] * value[filled + q]
            filled += count[j]
            out[i, j] = total
            out[j, i] = total
    return out
