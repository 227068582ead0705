"""Tiles of the lattice: each cell has its own place."""

import numpy as np

from gpom_core.jit import compiled
from gpom_core.rows import NONE, cell_key, find
from gpom_core.tiles import (
    TILE_CELLS,
    TILE_SHIFT,
    Tiles,
    new_tiles,
    place_in_tile,
    tile_at,
    with_room,
)


@compiled
def put(tiles: Tiles, ix: int, iy: int, row: int) -> None:
    tiles.hit[tile_at(tiles, ix, iy), place_in_tile(ix, iy)] = row


@compiled
def get(tiles: Tiles, ix: int, iy: int) -> int:
    tile = find(tiles.slots, tiles.keys, cell_key(0, ix >> TILE_SHIFT, iy >> TILE_SHIFT), 0)
    return NONE if tile == NONE else tiles.hit[tile, place_in_tile(ix, iy)]


def test_each_cell_keeps_what_was_put_there() -> None:
    cells = np.unique(np.random.default_rng(0).integers(-20, 20, (400, 2)), axis=0)
    tiles = new_tiles(8)
    for row, (x, y) in enumerate(cells):
        tiles = with_room(tiles, 1)
        put(tiles, int(x), int(y), row)
    assert tiles.size[0] == len(np.unique(cells // TILE_CELLS, axis=0))
    held = {(x, y): row for row, (x, y) in enumerate(cells.tolist())}
    for x in range(-25, 25):
        for y in range(-25, 25):
            assert get(tiles, x, y) == held.get((x, y), NONE)
    assert get(tiles, 500, 500) == NONE


def test_growing_keeps_what_tiles_hold() -> None:
    tiles = new_tiles(1)
    put(tiles, 5, 6, 42)
    tiles.first[0] = 7
    grown = with_room(tiles, 1000)
    assert get(grown, 5, 6) == 42
    assert grown.first[0] == 7
    assert (grown.first[1:] == NONE).all()
    assert with_room(grown, 1) is grown
