"""The free part of beams into rows: each cell that was crossed is counted once, by the length."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from gpom_core.clusters import Clusters, shift
from gpom_core.jit import compiled
from gpom_core.open_space import GRAZED, cross_whole, found_areas, is_open
from gpom_core.rows import NONE, Rows, cell_key, find_or_add
from gpom_core.tiles import FREE, HIT, TILE_AREA, Tiles, open_from
from gpom_core.walk import WINDOW_TILES, Crossed, crossed_in, walk

CONTRADICTED = 32.0  # what fades may be one of an expert's places; `news` looks at it closely


@compiled
def absorb_free_areas(
    start: tuple[int, int],
    spanned: tuple[int, int, int, int],
    origin: NDArray[np.float64],
    direction: NDArray[np.float64],
    free_m: NDArray[np.float64],
    homes: NDArray[np.int32],
    length_m: NDArray[np.float64],
    last: NDArray[np.int32],
    rows: Rows,
    tiles: Tiles,
    clusters: Clusters,
    cell_m: float,
    near_m: float,
    whole: bool,
    cap: float,
    hit_cap: float,
    hit_weight: float,
) -> tuple[int, int]:
    """Count the free part of beams in the cells that they cross, by length.

    Beams are walked window by window, of which most scans need one.

    Args:
        start: the window to begin with, and the tile in it if it was walked; at first 0 and NONE.
        spanned: see `walk.span`.
        origin: (2,) sensor. direction: (n, 2) unit. free_m: (n,) length of each free part.
        homes: (n,) cluster of each beam.
        length_m: (64 w,) 0 and last: (w,) NONE: a window of at least `walk.window_room` tiles. They
            are so again at the end.
        whole: whether a tile that no surface is near to is one row.
        hit_weight: how many traversals weigh as much as one hit.

    Returns:
        Where to go on when there is room for one more tile, its rows and a cluster; NONE, NONE
        when all is done.
    """
    tx, ty, nx, ny = spanned
    across, along = -(-nx // WINDOW_TILES), -(-ny // WINDOW_TILES)
    first = start[1]
    for window in range(start[0], across * along):
        dx, dy = window // along * WINDOW_TILES, window % along * WINDOW_TILES
        corner = tx + dx, ty + dy
        shape = min(nx - dx, WINDOW_TILES), min(ny - dy, WINDOW_TILES)
        if first == NONE:
            walk(origin, direction, free_m, corner, shape, cell_m, length_m, last)
            first = 0
        crossed = crossed_in(corner, shape, length_m, last)
        full = _merge(
            first, crossed, homes, rows, tiles, clusters,
            cell_m, near_m, whole, cap, hit_cap, hit_weight,
        )  # fmt: skip
        if full != NONE:
            return window, full
        first = int(NONE)
    return NONE, NONE


@compiled
def _merge(
    first: int, crossed: Crossed, homes: NDArray[np.int32], rows: Rows, tiles: Tiles,
    clusters: Clusters, cell_m: float, near_m: float, whole: bool, cap: float, hit_cap: float,
    hit_weight: float,
) -> int:  # fmt: skip
    """Count what was crossed in rows, tile by tile, from the `first` on.

    What is counted is taken out. Returns the first tile that there was no room for, or NONE.
    """
    crossed_m, per_cell = crossed.length_m, 1.0 / cell_m
    free, hits, count, owner = tiles.free, tiles.hit, rows.count, rows.owner
    gain, fresh = clusters.gain, clusters.fresh
    places = np.empty(TILE_AREA, np.uint8)  # unsigned: nobody counts from the end
    for w in range(first, len(crossed.beam)):
        if crossed.beam[w] == NONE:
            continue
        if (
            rows.size[0] + TILE_AREA > len(rows.keys)
            or tiles.size[0] == len(tiles.keys)
            or clusters.size[0] == len(clusters.head)
        ):
            return w
        tx, ty = crossed.corner[0] + w // crossed.breadth, crossed.corner[1] + w % crossed.breadth
        tile, _ = find_or_add(tiles.slots, tiles.keys, tiles.size, cell_key(0, tx, ty), 0)
        lengths, areas, surfaces = crossed_m[w], free[tile], hits[tile]
        n, missing = 0, 0
        for place in range(TILE_AREA):
            places[n] = place
            n += lengths[place] > 0.0
            missing += (lengths[place] > 0.0) & (areas[place] == NONE)
        home = homes[crossed.beam[w]]
        crossed.beam[w] = NONE
        if n == 0:
            continue  # rounding led a beam here, with nothing left to add
        if tiles.whole[tile] != NONE or (
            whole
            and tiles.used[tile, FREE] == 0
            and tiles.used[tile, HIT] == 0
            and is_open(tx, ty, tiles, open_from(near_m, cell_m))
        ):
            cross_whole(tx, ty, tile, home, lengths * per_cell, rows, tiles, clusters, cell_m, cap)
            lengths[:] = 0.0
            continue
        if missing > 0:
            spare = tiles.whole[tile]  # there is none
            found_areas(
                tx, ty, places[:n], tile, home, spare, rows, tiles, clusters, cell_m, near_m
            )
            for i in range(n):
                row = areas[places[i]]
                news = lengths[places[i]] * per_cell >= GRAZED
                fresh[owner[row]] += (count[row] == 0.0) & news
        at = owner[areas[places[0]]]
        moved = gain[at]  # kept at hand while areas are of one cluster, as most are
        for i in range(n):
            place = places[i]
            row = np.uint32(areas[place])
            before, added = count[row], lengths[place] * per_cell
            count[row] = before + added
            lengths[place] = 0.0
            if owner[row] != at:
                gain[at] = moved
                at = owner[row]
                moved = gain[at]
            if before < cap:
                hit, times, against = surfaces[place], 1.0, 0.0
                if hit != NONE:
                    times, against = CONTRADICTED, hit_weight * min(count[hit], hit_cap)
                moved += times * shift(before, added, against)
        gain[at] = moved
    return NONE
