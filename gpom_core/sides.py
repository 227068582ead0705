"""The sides of an expert's boxes, each distinct edge once: what makes many boxes cheap to query.

The kernel between a point and a box is a product over axes of a difference of error functions at
the box's two edges. Boxes of one lattice share their edges, so a query takes one error function an
edge, not four a box.
"""

from __future__ import annotations

from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from gpom_core.jit import compiled
from gpom_core.rows import BOX

SQRT_HALF: Final = 0.7071067811865476
_HALF_PI: Final = 1.5707963267948966
_THINNEST: Final = 1e-3  # length scales; a thinner side counts as that wide, an error of 1e-7


class Sides(NamedTuple):
    """Edges of n observations' boxes; rows of other observations are not used.

    Attributes:
        edges: (e,) sorted positions along x, then along y, in units of sqrt(2) length scales.
        corners: (n, 4) numbers of the edges xmin, xmax, ymin, ymax of each box.
        factor: (n,) pi / 2 over the area in square length scales.
    """

    edges: NDArray[np.float64]
    corners: NDArray[np.int32]
    factor: NDArray[np.float64]


@compiled
def sides_of(
    kinds: NDArray[np.uint8], geometry: NDArray[np.float64], length_scale_m: float
) -> Sides:
    """Find the distinct edges of the boxes among observations (n, 2, 2)."""
    n = len(kinds)
    corners, factor = np.zeros((n, 4), np.int32), np.zeros(n)
    edges = np.empty(4 * n)
    size = 0
    for axis in range(2):
        begin = size
        for i in range(n):
            if kinds[i] != BOX:
                continue
            low = geometry[i, 0, axis] / length_scale_m
            width = max(geometry[i, 1, axis] / length_scale_m - low, _THINNEST)
            low *= SQRT_HALF
            factor[i] = (_HALF_PI if axis == 0 else factor[i]) / width
            for end in range(2):
                edge = low + SQRT_HALF * width if end == 1 else low
                at = size - 1  # what came last is met again first
                while at >= begin and edges[at] != edge:
                    at -= 1
                if at < begin:
                    edges[size] = edge
                    at = size
                    size += 1
                corners[i, 2 * axis + end] = at
        _sort(kinds, edges[begin:size], corners[:, 2 * axis : 2 * axis + 2], begin)
    return Sides(edges[:size].copy(), corners, factor)


@compiled
def _sort(
    kinds: NDArray[np.uint8],
    edges: NDArray[np.float64],
    corners: NDArray[np.int32],
    begin: int,
) -> None:
    """Sort edges numbered from `begin` on, and renumber them in corners (n, 2)."""
    order = np.argsort(edges)
    rank = np.empty(len(edges), np.int32)
    for r in range(len(order)):
        rank[order[r]] = begin + r
    edges[:] = edges[order]
    for i in range(len(corners)):
        if kinds[i] == BOX:
            for end in range(2):
                corners[i, end] = rank[corners[i, end] - begin]
