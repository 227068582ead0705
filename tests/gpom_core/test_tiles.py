"""Tiles of the lattice: each cell has its own place, and squares of cells are read across tiles."""

import numpy as np
import pytest

from gpom_core.jit import compiled
from gpom_core.rows import NONE
from gpom_core.tiles import TILE_CELLS, Tiles, new_tiles, place_in_tile, square, tile_at, with_room


@compiled
def put(tiles: Tiles, ix: int, iy: int, row: int) -> None:
    tiles.hit[tile_at(tiles, ix, iy), place_in_tile(ix, iy)] = row


def around(tiles: Tiles, ix: int, iy: int, reach: int) -> np.ndarray:
    out = np.empty((2 * reach + 1, 2 * reach + 1), np.int32)
    square(tiles, tiles.hit, ix, iy, reach, out)
    return out


@pytest.mark.parametrize("reach", [0, 1, 3, 8, 11])
def test_a_square_shows_what_its_cells_hold(reach: int) -> None:
    rng = np.random.default_rng(reach)
    cells = np.unique(rng.integers(-20, 20, (400, 2)), axis=0)
    tiles = new_tiles(8)
    for row, (x, y) in enumerate(cells):
        tiles = with_room(tiles, 1)
        put(tiles, int(x), int(y), row)
    assert tiles.size[0] == len(np.unique(cells // TILE_CELLS, axis=0))
    held = {(x, y): row for row, (x, y) in enumerate(cells.tolist())}
    for ix, iy in [(0, 0), (-1, -1), (7, -8), (19, 3), (500, 500)]:
        got = around(tiles, ix, iy, reach)
        for dx in range(-reach, reach + 1):
            for dy in range(-reach, reach + 1):
                assert got[dx + reach, dy + reach] == held.get((ix + dx, iy + dy), NONE)


def test_looking_adds_no_tiles() -> None:
    tiles = new_tiles()
    around(tiles, 3, 4, 20)
    assert tiles.size[0] == 0


def test_growing_keeps_what_tiles_hold() -> None:
    tiles = new_tiles(1)
    put(tiles, 5, 6, 42)
    tiles.first[0] = 7
    grown = with_room(tiles, 1000)
    assert around(grown, 5, 6, 0)[0, 0] == 42
    assert grown.first[0] == 7
    assert (grown.first[1:] == NONE).all()
    assert with_room(grown, 1) is grown
