"""The free part of beams into rows: each cell that was crossed is counted once, by the length."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from gpom_core.clusters import Clusters, shift
from gpom_core.jit import compiled
from gpom_core.rows import BOX, NONE, Rows, add_unindexed, attach, cell_key, find, find_or_add
from gpom_core.surfaces import nearest_hit
from gpom_core.tiles import FREE, TILE_AREA, TILE_CELLS, TILE_SHIFT, Tiles
from gpom_core.walk import WINDOW_TILES, Crossed, span, walk

GRAZED = 0.5  # of a cell's edge; a cell that a scan went through by less is no news by itself

CONTRADICTED = 8.0  # what fades is a few of an expert's places; alone it must make it dirty


@compiled
def absorb_free_areas(
    start: int,
    origin: NDArray[np.float64],
    direction: NDArray[np.float64],
    free_m: NDArray[np.float64],
    homes: NDArray[np.int32],
    rows: Rows,
    tiles: Tiles,
    clusters: Clusters,
    cell_m: float,
    near_m: float,
    cap: float,
    hit_cap: float,
    hit_weight: float,
) -> tuple[int, int, int]:
    """Count the free part of beams in the cells that they cross, by length.

    Beams are walked window by window, of which most scans need one.

    Args:
        start: the window to begin with.
        origin: (2,) sensor. direction: (n, 2) unit. free_m: (n,) length of each free part.
        homes: (n,) cluster of each beam.
        hit_weight: how many traversals weigh as much as one hit.

    Returns:
        The first window that there was no room for, of which nothing was counted, and the rows and
        tiles that it may need; or NONE, 0, 0 when all is done.
    """
    tx, ty, nx, ny = span(origin, direction, free_m, cell_m)
    across, along = -(-nx // WINDOW_TILES), -(-ny // WINDOW_TILES)
    for window in range(start, across * along):
        dx, dy = window // along * WINDOW_TILES, window % along * WINDOW_TILES
        crossed = walk(
            origin, direction, free_m, (tx + dx, ty + dy),
            (min(nx - dx, WINDOW_TILES), min(ny - dy, WINDOW_TILES)), cell_m,
        )  # fmt: skip
        new_rows, new_tiles = _room_for(crossed, tiles)
        if rows.size[0] + new_rows > len(rows.keys) or tiles.size[0] + new_tiles > len(tiles.keys):
            return window, new_rows, new_tiles
        _merge(crossed, homes, rows, tiles, clusters, cell_m, near_m, cap, hit_cap, hit_weight)
    return NONE, 0, 0


@compiled
def _room_for(crossed: Crossed, tiles: Tiles) -> tuple[int, int]:
    """At most this many rows and tiles are new."""
    new_rows, new_tiles = 0, 0
    for w in range(len(crossed.beam)):
        if crossed.beam[w] != NONE:
            tx = crossed.corner[0] + w // crossed.breadth
            ty = crossed.corner[1] + w % crossed.breadth
            tile = find(tiles.slots, tiles.keys, cell_key(0, tx, ty), 0)
            new_tiles += tile == NONE
            new_rows += TILE_AREA - (0 if tile == NONE else int(tiles.used[tile, FREE]))
    return new_rows, new_tiles


@compiled
def _merge(
    crossed: Crossed, homes: NDArray[np.int32], rows: Rows, tiles: Tiles,
    clusters: Clusters, cell_m: float, near_m: float, cap: float, hit_cap: float, hit_weight: float,
) -> None:  # fmt: skip
    """Count what was crossed in rows, tile by tile. The caller has made room."""
    crossed_m, per_cell = crossed.length_m, 1.0 / cell_m
    free, hits, count, owner = tiles.free, tiles.hit, rows.count, rows.owner
    gain, fresh = clusters.gain, clusters.fresh
    places = np.empty(TILE_AREA, np.int64)
    for w in range(len(crossed.beam)):
        if crossed.beam[w] == NONE:
            continue
        tx, ty = crossed.corner[0] + w // crossed.breadth, crossed.corner[1] + w % crossed.breadth
        tile, _ = find_or_add(tiles.slots, tiles.keys, tiles.size, cell_key(0, tx, ty), 0)
        n, missing = 0, 0
        for place in range(TILE_AREA):
            places[n] = place
            n += crossed_m[w, place] > 0.0
            missing += (crossed_m[w, place] > 0.0) & (free[tile, place] == NONE)
        if missing > 0:
            home = homes[crossed.beam[w]]
            _new_free_areas(tx, ty, places[:n], tile, home, rows, tiles, clusters, cell_m, near_m)
            for i in range(n):
                row = free[tile, places[i]]
                news = crossed_m[w, places[i]] * per_cell >= GRAZED
                fresh[owner[row]] += (count[row] == 0.0) & news
        for i in range(n):
            row = free[tile, places[i]]
            before, added = count[row], crossed_m[w, places[i]] * per_cell
            count[row] = before + added
            if before < cap:
                hit = hits[tile, places[i]]
                if hit == NONE:
                    gain[owner[row]] += shift(before, added, 0.0)
                else:
                    against = hit_weight * min(count[hit], hit_cap)
                    gain[owner[row]] += CONTRADICTED * shift(before, added, against)


@compiled
def _new_free_areas(
    tx: int, ty: int, places: NDArray[np.int64], tile: int, home: int, rows: Rows, tiles: Tiles,
    clusters: Clusters, cell_m: float, near_m: float,
) -> None:  # fmt: skip
    """Rows for those places of a tile that have none, given to the cluster that is at home there.

    That is the cluster of the nearest hit; where none is near, that of the tile's first area in
    the open, or else `home`.
    """
    owner, before, after = rows.owner, rows.before, rows.after
    head, length = clusters.head, clusters.rows
    hit = NONE
    for place in places:
        if tiles.free[tile, place] != NONE:
            continue
        ix = tx * TILE_CELLS + (place >> TILE_SHIFT)
        iy = ty * TILE_CELLS + (place & (TILE_CELLS - 1))
        row = add_unindexed(rows, cell_key(BOX, ix, iy))
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
        mine = home
        if hit != NONE:
            mine = owner[hit]
        elif tiles.first[tile] == NONE:
            tiles.first[tile] = row
        else:
            mine = owner[tiles.first[tile]]
        attach(owner, before, after, head, length, row, mine)
