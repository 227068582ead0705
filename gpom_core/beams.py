"""Beams into rows: hits onto hit cells, the free part of beams onto free areas or free segments."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from gpom_core.clusters import Clusters, add_hit_moments, touch
from gpom_core.jit import compiled
from gpom_core.rows import NONE, Rows, add_unindexed, attach, cell_key, detach, find, find_or_add
from gpom_core.tiles import TILE_CELLS, TILE_SHIFT, Tiles, gap_to_tile, place_in_tile, tile_at

FREE, HIT = 0, 1  # columns of `Tiles.used`
POINT, SEGMENT, BOX = 0, 1, 2  # as kernels.Kind; plain numbers are what compiled code takes


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
) -> int:
    """Merge hits (n, 2) into their cells; new cells go to the clusters in `homes` (n,).

    A hit in a cell that is known stays with that cell's cluster, and `homes` is changed to it.
    Free areas nearer to a new surface than to any other follow its cluster.
    The caller has made room for n rows and n tiles. Returns the number of new rows.
    """
    fresh = 0
    for i in range(len(xy)):
        x, y = xy[i, 0], xy[i, 1]
        key = cell_key(POINT, int(np.floor(x / hit_cell_m)), int(np.floor(y / hit_cell_m)))
        row, new = find_or_add(rows.slots, rows.keys, rows.size, key, 0)
        if new:
            fresh += 1
            rows.kind[row] = POINT
            rows.geometry[row, :, 0] = x
            rows.geometry[row, :, 1] = y
            rows.near[row] = 0.0
            attach(rows, clusters.head, clusters.rows, row, homes[i])
            clusters.fresh[homes[i]] += 1
            add_hit_moments(clusters, homes[i], x, y)
            ix, iy = int(np.floor(x / cell_m)), int(np.floor(y / cell_m))
            tile, place = tile_at(tiles, ix, iy), place_in_tile(ix, iy)
            if tiles.hit[tile, place] == NONE:
                tiles.hit[tile, place] = row
                tiles.used[tile, HIT] += 1
                _claim_free_areas(row, rows, tiles, clusters, cell_m, near_m)
        else:
            homes[i] = rows.owner[row]
            share = 1.0 / (min(rows.count[row], cap - 1.0) + 1.0)  # a running mean that forgets
            rows.geometry[row, :, 0] += share * (x - rows.geometry[row, 0, 0])
            rows.geometry[row, :, 1] += share * (y - rows.geometry[row, 0, 1])
        touch(rows, clusters, row, 1.0, cap)
    return fresh


@compiled
def _claim_free_areas(
    hit: int, rows: Rows, tiles: Tiles, clusters: Clusters, cell_m: float, near_m: float
) -> None:
    """Give the free areas around a new surface to its cluster where it is the nearest."""
    home = rows.owner[hit]
    x, y = rows.geometry[hit, 0, 0], rows.geometry[hit, 0, 1]
    edge = TILE_CELLS * cell_m
    for tx in range(int(np.floor((x - near_m) / edge)), int(np.floor((x + near_m) / edge)) + 1):
        for ty in range(int(np.floor((y - near_m) / edge)), int(np.floor((y + near_m) / edge)) + 1):
            gap = gap_to_tile(tx, ty, x, y, cell_m)
            if gap >= near_m:
                continue
            tile = find(tiles.slots, tiles.keys, cell_key(0, tx, ty), 0)
            # most tiles have surfaces of their own, nearer than this one
            if tile == NONE or tiles.used[tile, FREE] == 0 or gap >= tiles.far_m[tile]:
                continue
            far = 0.0
            for place in range(TILE_CELLS * TILE_CELLS):
                row = tiles.free[tile, place]
                if row == NONE:
                    continue
                dx = (tx * TILE_CELLS + (place >> TILE_SHIFT) + 0.5) * cell_m - x
                dy = (ty * TILE_CELLS + (place & (TILE_CELLS - 1)) + 0.5) * cell_m - y
                d = np.sqrt(dx * dx + dy * dy)
                if d >= near_m or d >= rows.near[row]:
                    far = max(far, rows.near[row])
                    continue
                far = max(far, d)
                rows.near[row] = d
                if rows.owner[row] != home:
                    clusters.fresh[rows.owner[row]] += 1
                    clusters.fresh[home] += 1
                    detach(rows, clusters.head, clusters.rows, row)
                    attach(rows, clusters.head, clusters.rows, row, home)
            tiles.far_m[tile] = far


@compiled
def _nearest_hit(
    x: float, y: float, rows: Rows, tiles: Tiles, cell_m: float, near_m: float
) -> tuple[int, float]:
    """Row of the nearest hit within `near_m` of (x, y), or NONE, and its distance."""
    best, nearest = NONE, near_m
    edge = TILE_CELLS * cell_m
    middle_x, middle_y = int(np.floor(x / edge)), int(np.floor(y / edge))
    ring = 0
    while (ring - 1) * edge < nearest:  # rings of tiles, from the inside out
        for tx in range(middle_x - ring, middle_x + ring + 1):
            whole = abs(tx - middle_x) == ring
            for ty in range(middle_y - ring, middle_y + ring + 1, 1 if whole else 2 * ring):
                if gap_to_tile(tx, ty, x, y, cell_m) >= nearest:
                    continue
                tile = find(tiles.slots, tiles.keys, cell_key(0, tx, ty), 0)
                if tile == NONE or tiles.used[tile, HIT] == 0:
                    continue
                for place in range(TILE_CELLS * TILE_CELLS):
                    hit = tiles.hit[tile, place]
                    if hit != NONE:
                        dx, dy = x - rows.geometry[hit, 0, 0], y - rows.geometry[hit, 0, 1]
                        d = np.sqrt(dx * dx + dy * dy)
                        if d < nearest:
                            best, nearest = hit, d
        ring += 1
    return best, (nearest if best != NONE else np.inf)


@compiled
def _new_free_area(
    ix: int, iy: int, tile: int, home: int, rows: Rows, tiles: Tiles,
    clusters: Clusters, cell_m: float, near_m: float,
) -> int:  # fmt: skip
    """A new row for cell (ix, iy), given to the cluster that is at home there."""
    row = add_unindexed(rows, cell_key(BOX, ix, iy))
    tiles.free[tile, place_in_tile(ix, iy)] = row
    tiles.used[tile, FREE] += 1
    rows.kind[row] = BOX
    rows.geometry[row, 0, 0] = ix * cell_m
    rows.geometry[row, 0, 1] = iy * cell_m
    rows.geometry[row, 1, 0] = (ix + 1) * cell_m
    rows.geometry[row, 1, 1] = (iy + 1) * cell_m
    hit, rows.near[row] = _nearest_hit(
        (ix + 0.5) * cell_m, (iy + 0.5) * cell_m, rows, tiles, cell_m, near_m
    )
    tiles.far_m[tile] = max(tiles.far_m[tile], rows.near[row])
    if hit != NONE:
        home = rows.owner[hit]
    elif tiles.first[tile] == NONE:
        tiles.first[tile] = row
    else:
        home = rows.owner[tiles.first[tile]]
    attach(rows, clusters.head, clusters.rows, row, home)
    clusters.fresh[home] += 1
    return row


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
) -> tuple[int, int]:
    """Count the free part of beams in the cells that they cross, by length.

    Cell walking after Amanatides & Woo, "A fast voxel traversal algorithm" (1987).

    Args:
        start: the beam to begin with.
        origin: (2,) sensor. direction: (n, 2) unit. free_m: (n,) length of each free part.
        homes: (n,) cluster of each beam.

    Returns:
        The first beam that there was no room for (n when done), and the number of new rows.
    """
    fresh = 0
    x, y = origin[0], origin[1]
    per_cell = 1.0 / cell_m
    for b in range(start, len(free_m)):
        length = free_m[b]
        if not length > 0.0:
            continue
        worst = cells_crossed(length, cell_m)
        if rows.size[0] + worst > len(rows.keys) or tiles.size[0] + worst > len(tiles.keys):
            return b, fresh
        ux, uy = direction[b, 0], direction[b, 1]
        ix, iy = int(np.floor(x / cell_m)), int(np.floor(y / cell_m))
        sx, sy = (1 if ux > 0.0 else -1), (1 if uy > 0.0 else -1)
        next_x = ((ix + (ux > 0.0)) * cell_m - x) / ux if ux != 0.0 else np.inf
        next_y = ((iy + (uy > 0.0)) * cell_m - y) / uy if uy != 0.0 else np.inf
        step_x = cell_m / abs(ux) if ux != 0.0 else np.inf
        step_y = cell_m / abs(uy) if uy != 0.0 else np.inf
        t = 0.0
        tx, ty = ix >> TILE_SHIFT, iy >> TILE_SHIFT
        tile = tile_at(tiles, ix, iy)
        while t < length:
            leave = min(next_x, next_y, length)
            if leave > t:
                if ix >> TILE_SHIFT != tx or iy >> TILE_SHIFT != ty:
                    tx, ty = ix >> TILE_SHIFT, iy >> TILE_SHIFT
                    tile = tile_at(tiles, ix, iy)
                row = tiles.free[tile, place_in_tile(ix, iy)]
                if row == NONE:
                    fresh += 1
                    row = _new_free_area(
                        ix, iy, tile, homes[b], rows, tiles, clusters, cell_m, near_m
                    )
                touch(rows, clusters, row, (leave - t) * per_cell, cap)
                t = leave
            if next_x <= next_y:
                ix += sx
                next_x += step_x
            else:
                iy += sy
                next_y += step_y
    return len(free_m), fresh


@compiled
def cells_crossed(length_m: float, cell_m: float) -> int:
    """At most this many cells (or tiles) are crossed by a beam of `length_m`."""
    return int(2.0 * length_m / cell_m) + 4


@compiled
def absorb_free_segments(
    start: int,
    origin: NDArray[np.float64],
    direction: NDArray[np.float64],
    free_m: NDArray[np.float64],
    homes: NDArray[np.int32],
    rows: Rows,
    clusters: Clusters,
    segment_m: float,
    end_cell_m: float,
    cap: float,
) -> tuple[int, int]:
    """Cut the free part of beams into segments and merge those with the same pair of end cells.

    A beam's segments belong to the beam's cluster; one that is known stays with its cluster.
    Arguments and result as `absorb_free_areas`; `segment_m` is the longest segment.
    """
    fresh = 0
    for b in range(start, len(free_m)):
        length = free_m[b]
        if not length > 0.0:
            continue
        pieces = int(np.ceil(length / segment_m))
        if rows.size[0] + pieces > len(rows.keys):
            return b, fresh
        part = length / (pieces * segment_m)
        for p in range(pieces):
            t0, t1 = length * p / pieces, length * (p + 1) / pieces
            ax, ay = origin[0] + t0 * direction[b, 0], origin[1] + t0 * direction[b, 1]
            bx, by = origin[0] + t1 * direction[b, 0], origin[1] + t1 * direction[b, 1]
            key_a = cell_key(
                SEGMENT, int(np.floor(ax / end_cell_m)), int(np.floor(ay / end_cell_m))
            )
            key_b = cell_key(
                SEGMENT, int(np.floor(bx / end_cell_m)), int(np.floor(by / end_cell_m))
            )
            if key_b < key_a:  # the same segment, seen from its other end
                key_a, key_b = key_b, key_a
                ax, ay, bx, by = bx, by, ax, ay
            row, new = find_or_add(rows.slots, rows.keys, rows.size, key_a, key_b)
            if new:
                fresh += 1
                rows.kind[row] = SEGMENT
                rows.geometry[row, 0, 0] = ax
                rows.geometry[row, 0, 1] = ay
                rows.geometry[row, 1, 0] = bx
                rows.geometry[row, 1, 1] = by
                rows.near[row] = np.inf
                attach(rows, clusters.head, clusters.rows, row, homes[b])
                clusters.fresh[homes[b]] += 1
            else:
                g = rows.geometry[row]
                if key_a == key_b and (bx - ax) * (g[1, 0] - g[0, 0]) < (ay - by) * (
                    g[1, 1] - g[0, 1]
                ):  # both ends in one cell: only its direction tells which is which
                    ax, ay, bx, by = bx, by, ax, ay
                share = part / (min(rows.count[row], cap - part) + part)
                rows.geometry[row, 0, 0] += share * (ax - rows.geometry[row, 0, 0])
                rows.geometry[row, 0, 1] += share * (ay - rows.geometry[row, 0, 1])
                rows.geometry[row, 1, 0] += share * (bx - rows.geometry[row, 1, 0])
                rows.geometry[row, 1, 1] += share * (by - rows.geometry[row, 1, 1])
            touch(rows, clusters, row, part, cap)
    return len(free_m), fresh
