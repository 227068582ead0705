"""Hits into rows: surfaces, and the free areas before them, which belong to the nearest one."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from gpom_core.clusters import Clusters, add_hit_moments, shift
from gpom_core.jit import compiled
from gpom_core.rows import (
    COORDINATE_BITS,
    NONE,
    POINT,
    Rows,
    attach,
    cell_key,
    detach,
    find,
    find_or_add,
)
from gpom_core.tiles import (
    CLOSE,
    FREE,
    HIT,
    TILE_AREA,
    TILE_CELLS,
    TILE_SHIFT,
    Tiles,
    cells_to_tile,
    open_from,
    place_in_tile,
    tile_at,
)


@compiled
def absorb_hits(
    xy: NDArray[np.float64],
    homes: NDArray[np.int32],
    rows: Rows,
    tiles: Tiles,
    clusters: Clusters,
    hit_cell_m: float,
    cell_m: float,
    near_m: float,
    cap: float,
    free_cap: float,
    hit_weight: float,
) -> int:
    """Merge hits (n, 2) into their cells; new cells go to the clusters in `homes` (n,).

    A hit in a cell that is known stays with that cell's cluster, and `homes` is changed to it. New
    cells of the same run go to the cluster of the nearest known one.
    Free areas nearer to a new surface than to any other follow its cluster. `hit_weight` says how
    many traversals weigh as much as one hit.
    The caller has made room for n rows and n tiles. Returns the number of new rows.
    """
    n = len(xy)
    keys, found = np.empty(n, np.int64), np.empty(n, np.int32)
    slots, places = rows.slots, rows.keys
    fresh = 0
    for i in range(n):  # look-ups that wait for nothing but memory, so that they wait together
        keys[i] = cell_key(
            POINT, int(np.floor(xy[i, 0] / hit_cell_m)), int(np.floor(xy[i, 1] / hit_cell_m))
        )
        again = i > 0 and keys[i] == keys[i - 1]
        found[i] = found[i - 1] if again else find(slots, places, keys[i], 0)
        fresh += found[i] == NONE
    before = rows.size[0]
    if fresh > 0:
        _join_neighbours(xy, found, rows.owner, homes)
        for i in range(n):
            if found[i] == NONE:
                found[i], new = find_or_add(slots, places, rows.size, keys[i], 0)
                if new:
                    x, y = xy[i, 0], xy[i, 1]
                    _new_hit(found[i], x, y, homes[i], rows, tiles, clusters, cell_m, near_m)
    geometry, count, owner, gain = rows.geometry, rows.count, rows.owner, clusters.gain
    free, tile_slots, tile_keys = tiles.free, tiles.slots, tiles.keys
    tile, tx, ty = NONE, 1 << COORDINATE_BITS, 0  # no tile is there
    for i in range(n):
        row = found[i]
        known, homes[i] = count[row], owner[row]
        share = 1.0 / (min(known, cap - 1.0) + 1.0)  # a running mean that forgets
        x = geometry[row, 0, 0] + share * (xy[i, 0] - geometry[row, 0, 0])
        y = geometry[row, 0, 1] + share * (xy[i, 1] - geometry[row, 0, 1])
        geometry[row, 0, 0], geometry[row, 0, 1] = x, y
        geometry[row, 1, 0], geometry[row, 1, 1] = x, y
        count[row] = known + 1.0
        if known < cap:
            ix, iy = int(np.floor(x / cell_m)), int(np.floor(y / cell_m))
            if ix >> TILE_SHIFT != tx or iy >> TILE_SHIFT != ty:
                tx, ty = ix >> TILE_SHIFT, iy >> TILE_SHIFT
                tile = find(tile_slots, tile_keys, cell_key(0, tx, ty), 0)
            area = NONE if tile == NONE else free[tile, place_in_tile(ix, iy)]
            against = 0.0 if area == NONE else min(count[area], free_cap) / hit_weight
            gain[homes[i]] += shift(known, 1.0, against)
    return int(rows.size[0] - before)


@compiled
def _join_neighbours(
    xy: NDArray[np.float64],
    found: NDArray[np.int32],
    owner: NDArray[np.int32],
    homes: NDArray[np.int32],
) -> None:
    """Send new hits of a run home with the nearest hit that is known; `homes` tells runs apart.

    A long wall has many clusters, and a run along it belongs to one: cells that noise finds
    metres away from that would make it longer than allowed, again and again.
    """
    n = len(xy)
    before = np.full(n, NONE, np.int64)
    for i in range(n):
        if found[i] != NONE:
            before[i] = i
        elif i > 0 and homes[i] == homes[i - 1]:
            before[i] = before[i - 1]
    after, run = int(NONE), int(NONE)
    for i in range(n - 1, -1, -1):
        if homes[i] != run:
            after, run = int(NONE), int(homes[i])
        if found[i] != NONE:
            after = i
            continue
        best, nearest = int(NONE), np.inf
        for k in (before[i], after):
            if k != NONE:
                square = (xy[k, 0] - xy[i, 0]) ** 2 + (xy[k, 1] - xy[i, 1]) ** 2
                if square < nearest:
                    best, nearest = k, square
        if best != NONE:
            homes[i] = owner[found[best]]


@compiled
def _new_hit(
    row: int, x: float, y: float, home: int, rows: Rows, tiles: Tiles,
    clusters: Clusters, cell_m: float, near_m: float,
) -> None:  # fmt: skip
    """Fill a new row with a hit of cluster `home`."""
    rows.kind[row] = POINT
    for end in range(2):
        rows.geometry[row, end, 0], rows.geometry[row, end, 1] = x, y
    rows.near[row] = 0.0
    attach(rows.owner, rows.before, rows.after, clusters.head, clusters.rows, row, home)
    add_hit_moments(clusters, home, x, y)
    ix, iy = int(np.floor(x / cell_m)), int(np.floor(y / cell_m))
    tile, place = tile_at(tiles, ix, iy), place_in_tile(ix, iy)
    if tiles.hit[tile, place] == NONE:
        tiles.hit[tile, place] = row
        tiles.used[tile, HIT] += 1
        clusters.fresh[home] += 1  # another hit in a cell that is known to be a surface is no news
        _claim_free_areas(row, rows, tiles, clusters, cell_m, near_m)


@compiled
def _claim_free_areas(
    hit: int, rows: Rows, tiles: Tiles, clusters: Clusters, cell_m: float, near_m: float
) -> None:
    """Give the free areas around a new surface to its cluster where it is the nearest.

    Tiles around it that are one free area are to be divided.
    """
    near, far_m, free, used, around = rows.near, tiles.far_m, tiles.free, tiles.used, tiles.around
    slots, keys = tiles.slots, tiles.keys
    owner, before, after = rows.owner, rows.before, rows.after
    head, length, fresh = clusters.head, clusters.rows, clusters.fresh
    home = owner[hit]
    x, y = rows.geometry[hit, 0, 0], rows.geometry[hit, 0, 1]
    edge = TILE_CELLS * cell_m
    across = np.empty(TILE_CELLS)
    ix, iy = int(np.floor(x / cell_m)), int(np.floor(y / cell_m))
    reach = open_from(near_m, cell_m)
    reach_m = (reach + 1.0) * cell_m
    last_y = int(np.floor((y + reach_m) / edge))
    for tx in range(int(np.floor((x - reach_m) / edge)), int(np.floor((x + reach_m) / edge)) + 1):
        dx = max(tx * edge - x, x - (tx + 1) * edge, 0.0)
        for ty in range(int(np.floor((y - reach_m) / edge)), last_y + 1):
            dy = max(ty * edge - y, y - (ty + 1) * edge, 0.0)
            gap = dx * dx + dy * dy  # squared, like all distances here
            if gap >= reach_m * reach_m:
                continue
            tile = find(slots, keys, cell_key(0, tx, ty), 0)
            # most tiles have surfaces of their own, nearer than this one
            if tile == NONE or gap >= far_m[tile] * far_m[tile]:
                continue
            if tiles.whole[tile] != NONE and cells_to_tile(ix, iy, tx, ty) < reach * reach:
                tiles.close[tiles.size[CLOSE]] = tile
                tiles.size[CLOSE] += 1
                far_m[tile] = 0.0
                continue
            if used[tile, FREE] == 0:
                continue
            for i in range(TILE_CELLS):
                across[i] = ((ty * TILE_CELLS + i + 0.5) * cell_m - y) ** 2
            nearer = 0
            for i in range(TILE_CELLS):  # no branch within: eight cells at a time
                along = (tx * TILE_CELLS + i + 0.5) * cell_m - x
                for j in range(TILE_CELLS):
                    held = around[tile, i * TILE_CELLS + j]
                    nearer += 1 if along * along + across[j] < held else 0
            if nearer == 0 and far_m[tile] < np.inf:
                continue
            far_m[tile] = 0.0
            for place in range(TILE_AREA):
                row = free[tile, place]
                if row == NONE:
                    continue
                along = (tx * TILE_CELLS + (place >> TILE_SHIFT) + 0.5) * cell_m - x
                square = along * along + across[place & (TILE_CELLS - 1)]
                if square < around[tile, place]:
                    near[row] = np.sqrt(square)
                    around[tile, place] = near[row] * near[row]
                    if owner[row] != home:
                        fresh[owner[row]] += 1
                        fresh[home] += 1
                        detach(owner, before, after, head, length, row)
                        attach(owner, before, after, head, length, row, home)
                far_m[tile] = max(far_m[tile], near[row])


@compiled
def nearest_hit(
    x: float, y: float, guess: int, rows: Rows, tiles: Tiles, cell_m: float, near_m: float
) -> tuple[int, float]:
    """Row of the nearest hit within `near_m` of (x, y), or NONE, and its distance.

    The nearer the `guess`, a hit or NONE, the less is looked at.
    """
    geometry, slots, keys, used, hits = (
        rows.geometry,
        tiles.slots,
        tiles.keys,
        tiles.used,
        tiles.hit,
    )
    best, nearest = NONE, near_m * near_m  # squared, like all distances here
    if guess != NONE:
        dx, dy = x - geometry[guess, 0, 0], y - geometry[guess, 0, 1]
        d = dx * dx + dy * dy
        if d < nearest:
            best, nearest = guess, d
    edge = TILE_CELLS * cell_m
    middle_x, middle_y = int(np.floor(x / edge)), int(np.floor(y / edge))
    ring = 0
    while ring < 2 or ((ring - 1) * edge) ** 2 < nearest:  # of tiles, from the inside out
        for tx in range(middle_x - ring, middle_x + ring + 1):
            whole = abs(tx - middle_x) == ring
            gap_x = max(tx * edge - x, x - (tx + 1) * edge, 0.0)
            if gap_x * gap_x >= nearest:
                continue
            for ty in range(middle_y - ring, middle_y + ring + 1, 1 if whole else 2 * ring):
                gap_y = max(ty * edge - y, y - (ty + 1) * edge, 0.0)
                if gap_x * gap_x + gap_y * gap_y >= nearest:
                    continue
                tile = find(slots, keys, cell_key(0, tx, ty), 0)
                if tile == NONE or used[tile, HIT] == 0:
                    continue
                for place in range(TILE_AREA):
                    hit = hits[tile, place]
                    if hit != NONE:
                        dx, dy = x - geometry[hit, 0, 0], y - geometry[hit, 0, 1]
                        d = dx * dx + dy * dy
                        if d < nearest:
                            best, nearest = int(hit), d
        ring += 1
    return best, (np.sqrt(nearest) if best != NONE else np.inf)
