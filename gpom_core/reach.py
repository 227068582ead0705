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
_COUNTED_TILES = 1 << 14  # a larger window is sorted by comparing


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
def _window(geometry: NDArray[np.float64], tile: float, cutoff: float) -> tuple[int, int, int, int]:
    """First tile along x and y, and how many along each, that any shape can reach."""
    low_x, high_x = geometry[0, 0, 0], geometry[0, 0, 0]
    low_y, high_y = geometry[0, 0, 1], geometry[0, 0, 1]
    for i in range(len(geometry)):
        for end in range(2):
            low_x = min(low_x, geometry[i, end, 0])
            high_x = max(high_x, geometry[i, end, 0])
            low_y = min(low_y, geometry[i, end, 1])
            high_y = max(high_y, geometry[i, end, 1])
    x0, x1 = _tiles_of(low_x, high_x, cutoff, tile)
    y0, y1 = _tiles_of(low_y, high_y, cutoff, tile)
    return x0, y0, x1 - x0 + 1, y1 - y0 + 1


@compiled
def reach_of(geometry: NDArray[np.float64], tile_m: float, cutoff_m: float) -> Reach:
    """Index observations (n, 2, 2) by tiles of edge `tile_m` within `cutoff_m` of them."""
    keys, members = np.empty(0, np.int64), np.empty(0, np.int32)
    found = _pairs(geometry, tile_m, cutoff_m, keys, members)
    keys, members = np.empty(found, np.int64), np.empty(found, np.int32)
    _pairs(geometry, tile_m, cutoff_m, keys, members)
    if found == 0:
        return Reach(keys, np.zeros(1, np.int64), members)
    x0, y0, columns, rows = _window(geometry, tile_m, cutoff_m)
    if columns * rows <= _COUNTED_TILES:
        return _counted(keys, members, x0, y0, columns, rows)
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


@compiled
def _counted(
    keys: NDArray[np.int64], members: NDArray[np.int32], x0: int, y0: int, columns: int, rows: int
) -> Reach:
    """Sort pairs by counting them in a window of tiles: five times faster than comparing."""
    cursor = np.zeros(columns * rows + 1, np.int64)
    place = np.empty(len(keys), np.int64)
    for k in range(len(keys)):
        ix = (keys[k] >> TILE_BITS) - TILE_OFFSET - x0
        iy = (keys[k] & ((1 << TILE_BITS) - 1)) - TILE_OFFSET - y0
        place[k] = ix * rows + iy
        cursor[place[k] + 1] += 1
    used = 0
    for t in range(columns * rows):
        used += cursor[t + 1] > 0
    tiles, starts = np.empty(used, np.int64), np.empty(used + 1, np.int64)
    n = 0
    for t in range(columns * rows):
        count = cursor[t + 1]
        if count > 0:
            tiles[n] = tile_key(x0 + t // rows, y0 + t % rows)
            starts[n] = cursor[t]
            n += 1
        cursor[t + 1] = cursor[t] + count
    starts[n] = len(keys)
    out = np.empty(len(members), np.int32)
    for k in range(len(keys)):
        out[cursor[place[k]]] = members[k]
        cursor[place[k]] += 1
    return Reach(tiles, starts, out)
