"""Free space where no surface is near: one row for a whole tile, divided when a surface comes near.

A scan in a yard crosses a hundred thousand cells, and no two of them have anything different to
tell. A row of a tile is the box around the cells that were crossed. The tile remembers how often
each was, so that nothing is lost when it is divided, and no order of scans makes a difference.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from gpom_core.clusters import Clusters, add_cluster, shift
from gpom_core.jit import compiled
from gpom_core.rows import (
    BOX,
    COORDINATE_BITS,
    NONE,
    Rows,
    add_unindexed,
    attach,
    cell_key,
    detach,
    find,
)
from gpom_core.surfaces import nearest_hit
from gpom_core.tiles import (
    CLOSE,
    FREE,
    HIT,
    TILE_AREA,
    TILE_CELLS,
    TILE_SHIFT,
    Tiles,
    cells_to_tile,
)

BESIDE = 2  # tiles; open space farther apart is not of one cluster
GRAZED = 0.5  # of a cell's edge; a cell that a scan went through by less is no news by itself


@compiled
def is_open(tx: int, ty: int, tiles: Tiles, reach: float) -> bool:
    """Whether no cell with a hit is within `reach` cells of a tile's: see `tiles.open_from`."""
    slots, keys, used, hits = tiles.slots, tiles.keys, tiles.used, tiles.hit
    around = int(np.ceil(reach / TILE_CELLS))
    for x in range(tx - around, tx + around + 1):
        for y in range(ty - around, ty + around + 1):
            tile = find(slots, keys, cell_key(0, x, y), 0)
            if tile == NONE or used[tile, HIT] == 0:
                continue
            for place in range(TILE_AREA):
                if hits[tile, place] != NONE:
                    ix = x * TILE_CELLS + (place >> TILE_SHIFT)
                    iy = y * TILE_CELLS + (place & (TILE_CELLS - 1))
                    if cells_to_tile(ix, iy, tx, ty) < reach * reach:
                        return False
    return True


@compiled
def cross_whole(
    tx: int, ty: int, tile: int, home: int, length: NDArray[np.float64], rows: Rows, tiles: Tiles,
    clusters: Clusters, cell_m: float, cap: float,
) -> None:  # fmt: skip
    """Count lengths (64,), in cells, in the one row of a tile. The caller has made room.

    A new row belongs to open space nearby, or to `home` if that has no hits, or to a new cluster.
    """
    row, geometry = int(tiles.whole[tile]), rows.geometry
    new = row == NONE
    if new:
        row = add_unindexed(rows, cell_key(BOX, tx * TILE_CELLS, ty * TILE_CELLS))
        tiles.whole[tile] = row
        rows.kind[row] = BOX
        rows.near[row] = np.inf
        geometry[row, 0, :] = np.inf
        geometry[row, 1, :] = -np.inf
        home = _home(tx, ty, home, rows, tiles, clusters, cell_m)
        attach(rows.owner, rows.before, rows.after, clusters.head, clusters.rows, row, home)
    added = 0.0
    for place in range(TILE_AREA):
        if length[place] > 0.0:
            if tiles.passed[tile, place] == 0.0:
                ix = tx * TILE_CELLS + (place >> TILE_SHIFT)
                iy = ty * TILE_CELLS + (place & (TILE_CELLS - 1))
                rows.crossed[row] += 1
                geometry[row, 0, 0] = min(geometry[row, 0, 0], ix * cell_m)
                geometry[row, 0, 1] = min(geometry[row, 0, 1], iy * cell_m)
                geometry[row, 1, 0] = max(geometry[row, 1, 0], (ix + 1) * cell_m)
                geometry[row, 1, 1] = max(geometry[row, 1, 1], (iy + 1) * cell_m)
            tiles.passed[tile, place] += length[place]
            added += length[place]
    before = rows.count[row]
    rows.count[row] = before + added
    if new:
        clusters.fresh[rows.owner[row]] += added >= GRAZED
    elif before < cap * TILE_AREA:  # a beam straight through is one observation
        clusters.gain[rows.owner[row]] += shift(before / TILE_CELLS, added / TILE_CELLS, 0.0)


@compiled
def _home(
    tx: int, ty: int, home: int, rows: Rows, tiles: Tiles, clusters: Clusters, cell_m: float
) -> int:
    """Cluster of a tile in open space: that of open space nearby, else one without hits.

    What is far from all surfaces changes slowly, and is known by few beams: it is better told by
    experts of its own, whose length scale is long.
    """
    for dx in range(-BESIDE, BESIDE + 1):
        for dy in range(-BESIDE, BESIDE + 1):
            tile = find(tiles.slots, tiles.keys, cell_key(0, tx + dx, ty + dy), 0)
            if tile != NONE and tiles.whole[tile] != NONE and (dx != 0 or dy != 0):
                return int(rows.owner[tiles.whole[tile]])
    if clusters.moments[home, 0] > 0.0:
        return add_cluster(
            clusters, (tx + 0.5) * TILE_CELLS * cell_m, (ty + 0.5) * TILE_CELLS * cell_m
        )
    return home


@compiled
def divide_close(
    rows: Rows, tiles: Tiles, clusters: Clusters, cell_m: float, near_m: float
) -> None:
    """Give every cell of the tiles that surfaces came near to a row. The caller has made room."""
    offset, mask = 1 << (COORDINATE_BITS - 1), (1 << COORDINATE_BITS) - 1
    for i in range(tiles.size[CLOSE]):
        tile = int(np.int64(tiles.close[i]))  # as from `rows.find_or_add`
        key = tiles.keys[tile, 0]
        tx, ty = ((key >> COORDINATE_BITS) & mask) - offset, (key & mask) - offset
        row = tiles.whole[tile]
        home = rows.owner[row]
        detach(rows.owner, rows.before, rows.after, clusters.head, clusters.rows, row)
        clusters.fresh[home] += 1
        tiles.whole[tile] = NONE
        rows.crossed[row] = 0
        n, places = 0, np.empty(TILE_AREA, np.uint8)
        for place in range(TILE_AREA):
            places[n] = place
            n += tiles.passed[tile, place] > 0.0
        places = places[:n]
        found_areas(tx, ty, places, tile, home, row, rows, tiles, clusters, cell_m, near_m)
        for at in places:
            area = tiles.free[tile, at]
            rows.count[area] = tiles.passed[tile, at]
            clusters.fresh[rows.owner[area]] += 1
        tiles.passed[tile, :] = 0.0
    tiles.size[CLOSE] = 0


@compiled
def found_areas(
    tx: int, ty: int, places: NDArray[np.uint8], tile: int, home: int, spare: int, rows: Rows,
    tiles: Tiles, clusters: Clusters, cell_m: float, near_m: float,
) -> None:  # fmt: skip
    """Rows for those places of a tile that have none, given to the cluster that is at home there.

    That is the cluster of the nearest hit; where none is near, that of the tile's first area in
    the open, or else `home`. The first is `spare`, a row without owner, unless that is NONE.
    """
    owner, before, after = rows.owner, rows.before, rows.after
    head, length = clusters.head, clusters.rows
    hit, row = int(NONE), spare
    for place in places:
        if tiles.free[tile, place] != NONE:
            continue
        ix = tx * TILE_CELLS + int(place >> TILE_SHIFT)
        iy = ty * TILE_CELLS + int(place & (TILE_CELLS - 1))
        if row == NONE:
            row = add_unindexed(rows, 0)
        rows.keys[row, 0] = cell_key(BOX, ix, iy)
        tiles.free[tile, place] = row
        tiles.used[tile, FREE] += 1
        rows.kind[row] = BOX
        rows.geometry[row, 0, 0] = ix * cell_m
        rows.geometry[row, 0, 1] = iy * cell_m
        rows.geometry[row, 1, 0] = (ix + 1) * cell_m
        rows.geometry[row, 1, 1] = (iy + 1) * cell_m
        hit, rows.near[row] = nearest_hit(
            (ix + 0.5) * cell_m, (iy + 0.5) * cell_m, hit, rows, tiles, cell_m, near_m
        )
        tiles.far_m[tile] = max(tiles.far_m[tile], rows.near[row])
        tiles.around[tile, place] = min(rows.near[row], near_m) ** 2
        mine = home
        if hit != NONE:
            mine = owner[hit]
        elif tiles.first[tile] == NONE:
            tiles.first[tile] = row
        else:
            mine = owner[tiles.first[tile]]
        attach(owner, before, after, head, length, row, mine)
        row = NONE
