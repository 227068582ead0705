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
_COUNTED_TILES = 1 << 14  # a larger window is sorted by comparing, five times slower


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


def index_of(key: int) -> tuple[int, int]:
    """The index that `tile_key` made a key of."""
    return (key >> TILE_BITS) - TILE_OFFSET, (key & ((1 << TILE_BITS) - 1)) - TILE_OFFSET


@compiled
def _tiles_of(low: float, high: float, cutoff: float, tile: float) -> tuple[int, int]:
    return int(np.floor((low - cutoff) / tile)), int(np.floor((high + cutoff) / tile))


@compiled
def reach_of(geometry: NDArray[np.float64], tile_m: float, cutoff_m: float) -> Reach:
    """Index observations (n, 2, 2) by tiles of edge `tile_m` within `cutoff_m` of them."""
    n = len(geometry)
    first, last = np.empty((n, 2), np.int64), np.empty((n, 2), np.int64)
    for i in range(n):
        for axis in range(2):
            a, b = geometry[i, 0, axis], geometry[i, 1, axis]
            low, high = _tiles_of(min(a, b), max(a, b), cutoff_m, tile_m)
            first[i, axis], last[i, axis] = low, high
    if n == 0:
        return Reach(np.empty(0, np.int64), np.zeros(1, np.int64), np.empty(0, np.int32))
    x0, y0 = first[:, 0].min(), first[:, 1].min()
    columns, rows = last[:, 0].max() - x0 + 1, last[:, 1].max() - y0 + 1
    if columns * rows <= _COUNTED_TILES:
        return _counted(geometry, tile_m, cutoff_m, (first, last), (x0, y0, columns, rows))
    place, members = _pairs(geometry, tile_m, cutoff_m, (first, last), (x0, y0, columns, rows))
    order = np.argsort(place, kind="mergesort")
    return _grouped(place[order], members[order], x0, y0, rows)


@compiled
def _pairs(
    geometry: NDArray[np.float64],
    tile: float,
    cutoff: float,
    tiles: tuple[NDArray[np.int64], NDArray[np.int64]],
    window: tuple[int, int, int, int],
) -> tuple[NDArray[np.int64], NDArray[np.int32]]:
    """Place in the window of every tile that a shape reaches, and the number of the shape."""
    first, last = tiles
    strip_place, length = _strips(geometry, tile, cutoff, tiles, window)
    found = length.sum()
    place, members = np.empty(found, np.int64), np.empty(found, np.int32)
    pair, strip = 0, 0
    for i in range(len(geometry)):
        for _ in range(first[i, 0], last[i, 0] + 1):
            for step in range(length[strip]):
                place[pair], members[pair] = strip_place[strip] + step, i
                pair += 1
            strip += 1
    return place, members


@compiled
def _grouped(
    place: NDArray[np.int64], members: NDArray[np.int32], x0: int, y0: int, rows: int
) -> Reach:
    """The index of pairs that are sorted by place."""
    found = len(place)
    tiles, starts = np.empty(found, np.int64), np.empty(found + 1, np.int64)
    n = 0
    for k in range(found):
        if k == 0 or place[k] != place[k - 1]:
            tiles[n], starts[n] = tile_key(x0 + place[k] // rows, y0 + place[k] % rows), k
            n += 1
    starts[n] = found
    return Reach(tiles[:n].copy(), starts[: n + 1].copy(), members)


@compiled
def _strips(
    geometry: NDArray[np.float64],
    tile: float,
    cutoff: float,
    tiles: tuple[NDArray[np.int64], NDArray[np.int64]],
    window: tuple[int, int, int, int],
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Of each column of tiles that each shape may reach, the place of the first and how many.

    They are one strip, for a box grown by a distance is convex.
    """
    (first, last), (x0, y0, _, rows) = tiles, window
    strips = 0
    for i in range(len(geometry)):
        strips += last[i, 0] - first[i, 0] + 1
    place, length = np.empty(strips, np.int64), np.empty(strips, np.int64)
    across = np.empty(rows)
    strip = 0
    for i in range(len(geometry)):
        g = geometry[i]
        low_x, high_x = min(g[0, 0], g[1, 0]), max(g[0, 0], g[1, 0])
        low_y, high_y = min(g[0, 1], g[1, 1]), max(g[0, 1], g[1, 1])
        begin, reached = first[i, 1], last[i, 1] - first[i, 1] + 1
        for r in range(reached):
            dy = max((begin + r) * tile - high_y, low_y - (begin + r + 1) * tile, 0.0)
            across[r] = dy * dy
        for ix in range(first[i, 0], last[i, 0] + 1):
            dx = max(ix * tile - high_x, low_x - (ix + 1) * tile, 0.0)
            low, end = 0, reached
            while low < end and not dx * dx + across[low] < cutoff * cutoff:
                low += 1
            while end > low and not dx * dx + across[end - 1] < cutoff * cutoff:
                end -= 1
            place[strip], length[strip] = (ix - x0) * rows + begin - y0 + low, end - low
            strip += 1
    return place, length


@compiled
def _counted(
    geometry: NDArray[np.float64],
    tile: float,
    cutoff: float,
    tiles: tuple[NDArray[np.int64], NDArray[np.int64]],
    window: tuple[int, int, int, int],
) -> Reach:
    """The index of shapes in a window that is not too large, by counting first and filling then.

    Args:
        tiles: (n, 2) first and last that each shape may reach.
        window: first tile along x and y, and how many there are along each.
    """
    x0, y0, columns, rows = window
    place, length = _strips(geometry, tile, cutoff, tiles, window)
    cursor = np.zeros(columns * rows + 1, np.int64)
    for strip in range(len(place)):
        for t in range(place[strip], place[strip] + length[strip]):
            cursor[t + 1] += 1
    used = 0
    for t in range(columns * rows):
        used += cursor[t + 1] > 0
    keys, starts = np.empty(used, np.int64), np.empty(used + 1, np.int64)
    n, t = 0, 1
    for ix in range(x0, x0 + columns):
        for iy in range(y0, y0 + rows):
            if cursor[t] > 0:
                keys[n], starts[n] = tile_key(ix, iy), cursor[t - 1]
                n += 1
            cursor[t] += cursor[t - 1]
            t += 1
    found = length.sum()
    starts[n] = found
    members = np.empty(found, np.int32)
    first, last = tiles
    strip = 0
    for i in range(len(geometry)):
        for _ in range(first[i, 0], last[i, 0] + 1):
            for t in range(place[strip], place[strip] + length[strip]):
                members[cursor[t]] = i
                cursor[t] += 1
            strip += 1
    return Reach(keys, starts, members)
