"""Where an expert's evidence reaches: for each small tile of the map, the observations near it.

This index of evidence is what makes queries cheap. A tile lists only observations within the
cut-off of it, so a query touches the few that matter of the few experts that matter.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from gpom_core.jit import compiled

TILE_BITS = 31
TILE_OFFSET = 1 << (TILE_BITS - 1)


class Reach(NamedTuple):
    """Tiles that an expert reaches, and its observations near each.

    Attributes:
        tiles: (t,) sorted keys, see `tile_key`.
        starts: (t + 1,) where each tile's part of `members` begins.
        members: (s,) numbers of observations.
    """

    tiles: NDArray[np.int64]
    starts: NDArray[np.int64]
    members: NDArray[np.int32]


@compiled
def tile_key(ix: int, iy: int) -> int:
    """Key of the tile with index (ix, iy), |index| < 2^30."""
    return ((ix + TILE_OFFSET) << TILE_BITS) | (iy + TILE_OFFSET)


@compiled
def _tiles_of(low: float, high: float, cutoff: float, tile: float) -> tuple[int, int]:
    return int(np.floor((low - cutoff) / tile)), int(np.floor((high + cutoff) / tile))


@compiled
def _is_near(shape: NDArray[np.float64], ix: int, iy: int, tile: float, cutoff: float) -> bool:
    """Whether the bounding box of a shape (2, 2) is within the cut-off of a tile."""
    dx = max(ix * tile - max(shape[0, 0], shape[1, 0]), 0.0)
    dx = max(min(shape[0, 0], shape[1, 0]) - (ix + 1) * tile, dx)
    dy = max(iy * tile - max(shape[0, 1], shape[1, 1]), 0.0)
    dy = max(min(shape[0, 1], shape[1, 1]) - (iy + 1) * tile, dy)
    return bool(dx * dx + dy * dy < cutoff * cutoff)


@compiled
def _pairs(geometry: NDArray[np.float64], tile: float, cutoff: float, keys: NDArray[np.int64],
           members: NDArray[np.int32]) -> int:  # fmt: skip
    """Write (tile key, observation) pairs if there is room; how many there are."""
    found = 0
    for i in range(len(geometry)):
        g = geometry[i]
        x0, x1 = _tiles_of(min(g[0, 0], g[1, 0]), max(g[0, 0], g[1, 0]), cutoff, tile)
        y0, y1 = _tiles_of(min(g[0, 1], g[1, 1]), max(g[0, 1], g[1, 1]), cutoff, tile)
        for ix in range(x0, x1 + 1):
            for iy in range(y0, y1 + 1):
                if _is_near(g, ix, iy, tile, cutoff):
                    if found < len(keys):
                        keys[found] = tile_key(ix, iy)
                        members[found] = i
                    found += 1
    return found


@compiled
def reach_of(geometry: NDArray[np.float64], tile_m: float, cutoff_m: float) -> Reach:
    """Index observations (n, 2, 2) by tiles of edge `tile_m` within `cutoff_m` of them."""
    keys, members = np.empty(0, np.int64), np.empty(0, np.int32)
    found = _pairs(geometry, tile_m, cutoff_m, keys, members)
    keys, members = np.empty(found, np.int64), np.empty(found, np.int32)
    _pairs(geometry, tile_m, cutoff_m, keys, members)
    order = np.argsort(keys, kind="mergesort")
    keys, members = keys[order], members[order]
    tiles, starts = np.empty(found, np.int64), np.empty(found + 1, np.int64)
    n = 0
    for k in range(found):
        if k == 0 or keys[k] != keys[k - 1]:
            tiles[n], starts[n] = keys[k], k
            n += 1
    starts[n] = found
    return Reach(tiles[:n].copy(), starts[: n + 1].copy(), members)
