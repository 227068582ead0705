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
    boxes = np.flatnonzero(kinds == BOX)
    corners = np.zeros((len(kinds), 4), np.int32)
    factor = np.zeros(len(kinds))
    factor[boxes] = _HALF_PI
    edges = np.empty(4 * len(boxes))
    size = 0
    for axis in range(2):
        low = geometry[:, 0, axis].copy()[boxes] / length_scale_m
        high = geometry[:, 1, axis].copy()[boxes] / length_scale_m
        width = np.maximum(high - low, _THINNEST)
        factor[boxes] /= width
        low *= SQRT_HALF
        high = low + SQRT_HALF * width
        distinct = np.unique(np.concatenate((low, high)))
        corners[boxes, 2 * axis] = size + np.searchsorted(distinct, low)
        corners[boxes, 2 * axis + 1] = size + np.searchsorted(distinct, high)
        edges[size : size + len(distinct)] = distinct
        size += len(distinct)
    return Sides(edges[:size].copy(), corners, factor)
