"""Line tracking within one scan (Algorithm 1 of Kim & Kim, Sensors 2022).

The hits of a scan are ordered by angle. A hit joins the run before it while it is near the last
hit and near the line fitted to the run; otherwise it begins a new run.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from gpom_core.jit import compiled, inlined

GAP_IN_BEAMS = 3.0  # a wall seen at a slant spreads neighbouring hits this much, and no more
STRAIGHT_FROM = 3.0  # in tolerances: shorter runs have no direction to deviate from


@compiled
def moments_of(xy: NDArray[np.float64], out: NDArray[np.float64]) -> None:
    """Add points (n, 2) to the moments (n, sx, sy, sxx, sxy, syy) in `out`."""
    for i in range(len(xy)):
        x, y = xy[i, 0], xy[i, 1]
        out[0] += 1.0
        out[1] += x
        out[2] += y
        out[3] += x * x
        out[4] += x * y
        out[5] += y * y


@compiled
def principal_axis(m: NDArray[np.float64]) -> tuple[float, float, float, float, float, float]:
    """Total least squares line through the points behind the moments `m` (6,).

    Returns:
        Mean x, mean y, unit direction x, y, variance along and across the line (same units²).
    """
    n = m[0]
    cx, cy = m[1] / n, m[2] / n
    xx = max(m[3] / n - cx * cx, 0.0)
    yy = max(m[5] / n - cy * cy, 0.0)
    xy = m[4] / n - cx * cy
    half, diff = 0.5 * (xx + yy), 0.5 * (xx - yy)
    root = np.sqrt(diff * diff + xy * xy)
    # cosine and sine of half the angle of (diff, xy), each from the larger of them
    tx, ty = 1.0, 0.0
    if root < 1e-150:  # m²: squares of that are no longer numbers
        return cx, cy, tx, ty, half + root, max(half - root, 0.0)
    if diff > 0.0:
        tx = np.sqrt(0.5 + 0.5 * diff / root)
        ty = 0.5 * xy / (root * tx)
    else:
        ty = np.sqrt(0.5 - 0.5 * diff / root) * (1.0 if xy >= 0.0 else -1.0)
        tx = 0.5 * xy / (root * ty)
    return cx, cy, tx, ty, half + root, max(half - root, 0.0)


@inlined
def _distance(dx: float, dy: float) -> float:
    return float(np.sqrt(dx * dx + dy * dy))


@compiled
def track_lines(
    xy: NDArray[np.float64],
    spacing_m: NDArray[np.float64],
    tolerance_m: float,
    gap_m: float,
) -> NDArray[np.int64]:
    """Split the ordered hits of a scan into collinear runs.

    Args:
        xy: (n, 2) hits in order of their angle, metres.
        spacing_m: (n,) distance that one angular step spans at each hit's range.
        tolerance_m: farthest that a hit may lie from the line of its run.
        gap_m: longest distance between neighbours, or `GAP_IN_BEAMS` spacings if that is more.

    Returns:
        (n + 1,) where each run starts, padded with n after the last run.
    """
    n = len(xy)
    starts = np.full(n + 1, n, np.int64)
    if n == 0:
        return starts
    m = np.zeros(6)
    runs, start = 1, 0
    starts[0] = 0
    ox, oy = xy[0, 0], xy[0, 1]
    for i in range(n):
        x, y = xy[i, 0], xy[i, 1]
        if i > start:
            px, py = xy[i - 1, 0], xy[i - 1, 1]
            joins = _distance(x - px, y - py) <= max(gap_m, GAP_IN_BEAMS * spacing_m[i])
            if joins and _distance(x - ox, y - oy) > STRAIGHT_FROM * tolerance_m and m[0] > 2.0:
                cx, cy, tx, ty, _, _ = principal_axis(m)
                joins = abs((y - oy - cy) * tx - (x - ox - cx) * ty) <= tolerance_m
            if not joins:
                start = i
                starts[runs] = i
                runs += 1
        if i == start:  # moments relative to the first hit: exact far from the map's origin
            m[:] = 0.0
            ox, oy = x, y
        dx, dy = x - ox, y - oy
        m[0] += 1.0
        m[1] += dx
        m[2] += dy
        m[3] += dx * dx
        m[4] += dx * dy
        m[5] += dy * dy
    return starts
