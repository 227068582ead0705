"""The lattice of the map: tiles of 8 x 8 cells that know the free area and the hit in each cell.

A tile is found by hashing, its cells by counting: a beam that walks through cells asks the hash
once a tile, which measured 4 times faster than once a cell.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import carray
from numpy.typing import NDArray

from gpom_core.jit import compiled, inlined
from gpom_core.pointers import pointer
from gpom_core.rows import NONE, cell_key, find_or_add, table_size

TILE_SHIFT = 3
TILE_CELLS = 1 << TILE_SHIFT
TILE_AREA = TILE_CELLS * TILE_CELLS
FREE, HIT = 0, 1  # columns of `Tiles.used`
CLOSE = 1  # in `Tiles.size`


class Tiles(NamedTuple):
    """Struct of arrays; `size[0]` tiles are in use, all others hold NONE.

    A tile that no surface is near to may have one free area for all its cells.

    Attributes:
        slots, keys: hash index, as in `Rows`.
        free: (t, 64) row of the free area of each cell.
        hit: (t, 64) row of the first hit in each cell.
        used: (t, 2) how many cells have a free area, and how many a hit.
        around: (t, 64) squared distance from the free area of each cell within which a new hit is
            its nearest; 0 where there is none.
        far_m: (t,) no free area of the tile is farther from its nearest hit.
        first: (t,) row of the tile's first free area in the open: its cluster is at home here.
        whole: (t,) row of the free area that stands for all cells, or NONE.
        passed: (t, 64) how often its cells were crossed; 0 where cells have rows of their own.
        close: (t,) the first `size[1]` of these are tiles to divide: a surface came near to them.
    """

    slots: NDArray[np.int32]
    keys: NDArray[np.int64]
    free: NDArray[np.int32]
    hit: NDArray[np.int32]
    used: NDArray[np.int32]
    around: NDArray[np.float64]
    far_m: NDArray[np.float64]
    first: NDArray[np.int32]
    whole: NDArray[np.int32]
    passed: NDArray[np.float64]
    close: NDArray[np.int32]
    size: NDArray[np.int64]


def new_tiles(capacity: int = 256) -> Tiles:
    """No tiles, with room for `capacity`."""
    return Tiles(
        slots=np.full(table_size(capacity), NONE, np.int32),
        keys=np.zeros((capacity, 2), np.int64),
        free=np.full((capacity, TILE_AREA), NONE, np.int32),
        hit=np.full((capacity, TILE_AREA), NONE, np.int32),
        used=np.zeros((capacity, 2), np.int32),
        around=np.zeros((capacity, TILE_AREA)),
        far_m=np.full(capacity, np.inf),
        first=np.full(capacity, NONE, np.int32),
        whole=np.full(capacity, NONE, np.int32),
        passed=np.zeros((capacity, TILE_AREA)),
        close=np.zeros(capacity, np.int32),
        size=np.zeros(2, np.int64),
    )


@compiled
def tiles_at(handle: NDArray[np.int64]) -> Tiles:
    """The tiles behind a handle, see `gpom_core.handles`."""
    capacity = handle[1, 1]
    return Tiles(
        carray(pointer(handle[0, 0]), handle[0, 1], np.int32),
        carray(pointer(handle[1, 0]), (capacity, 2), np.int64),
        carray(pointer(handle[2, 0]), (capacity, TILE_AREA), np.int32),
        carray(pointer(handle[3, 0]), (capacity, TILE_AREA), np.int32),
        carray(pointer(handle[4, 0]), (capacity, 2), np.int32),
        carray(pointer(handle[5, 0]), (capacity, TILE_AREA), np.float64),
        carray(pointer(handle[6, 0]), capacity, np.float64),
        carray(pointer(handle[7, 0]), capacity, np.int32),
        carray(pointer(handle[8, 0]), capacity, np.int32),
        carray(pointer(handle[9, 0]), (capacity, TILE_AREA), np.float64),
        carray(pointer(handle[10, 0]), capacity, np.int32),
        carray(pointer(handle[11, 0]), 2, np.int64),
    )


def with_room(tiles: Tiles, extra: int) -> Tiles:
    """`tiles`, or a grown copy with room for `extra` more."""
    used, capacity = int(tiles.size[0]), len(tiles.keys)
    if used + extra <= capacity:
        return tiles
    grown = new_tiles(max(2 * capacity, used + extra))
    for name in ("free", "hit", "used", "far_m", "first", "whole", "close"):
        getattr(grown, name)[:used] = getattr(tiles, name)[:used]
    whole = np.flatnonzero(tiles.whole[:used] != NONE)
    grown.passed[whole] = tiles.passed[whole]  # the others' memory is never touched
    divided = np.flatnonzero(tiles.used[:used, FREE])
    grown.around[divided] = tiles.around[divided]  # nor is that of these
    grown.size[CLOSE] = tiles.size[CLOSE]
    _index(grown, tiles.keys[:used])
    return grown


@compiled
def _index(tiles: Tiles, keys: NDArray[np.int64]) -> None:
    for i in range(len(keys)):
        find_or_add(tiles.slots, tiles.keys, tiles.size, keys[i, 0], 0)


@inlined
def tile_at(tiles: Tiles, ix: int, iy: int) -> int:
    """Tile that holds cell (ix, iy), added if it is new. The caller has made room."""
    tile, _ = find_or_add(
        tiles.slots, tiles.keys, tiles.size, cell_key(0, ix >> TILE_SHIFT, iy >> TILE_SHIFT), 0
    )
    return tile


@inlined
def place_in_tile(ix: int, iy: int) -> int:
    """Number of cell (ix, iy) within its tile."""
    return ((ix & (TILE_CELLS - 1)) << TILE_SHIFT) | (iy & (TILE_CELLS - 1))


@inlined
def cells_to_tile(ix: int, iy: int, tx: int, ty: int) -> int:
    """Squared distance of cell (ix, iy) from the nearest cell of the tile (tx, ty), in cells."""
    dx = max(tx * TILE_CELLS - ix, ix - (tx * TILE_CELLS + TILE_CELLS - 1), 0)
    dy = max(ty * TILE_CELLS - iy, iy - (ty * TILE_CELLS + TILE_CELLS - 1), 0)
    return dx * dx + dy * dy


@inlined
def open_from(near_m: float, cell_m: float) -> float:
    """Distance in cells from which on a cell with a hit is not near to a tile, wherever it is hit.

    Cells are compared and not hits, which move: no order of scans makes a difference.
    """
    return near_m / cell_m + 0.75  # the hit may be at the near corner of its cell
