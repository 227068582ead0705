"""A scan into evidence in one call of compiled code, which stops where arrays have to grow."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from gpom_core.areas import absorb_free_areas
from gpom_core.beams import absorb_free_segments
from gpom_core.clusters import Clusters, clusters_at
from gpom_core.jit import compiled
from gpom_core.open_space import divide_close
from gpom_core.rows import NONE, Rows, rows_at
from gpom_core.sight import (
    BEAMS,
    CLUSTERS_BEFORE,
    HITS,
    LONG,
    NEEDED,
    ROWS_BEFORE,
    STAGE,
    TILE,
    WINDOW,
    Rules,
    Sight,
    see,
    sight_at,
)
from gpom_core.tiles import CLOSE, TILE_AREA, TILE_SHIFT, Tiles, tiles_at
from gpom_core.walk import span, window_room

_SEE, _DIVIDE, _COUNT, _DONE = range(4)


@compiled
def integrate(
    new: bool,
    ranges_m: NDArray[np.float32],
    pose: tuple[float, float],
    angles_rad: tuple[float, float],
    limits_m: tuple[float, float, float],
    numbers: tuple[float, ...],
    segments: bool,
    row_handle: NDArray[np.int64],
    tile_handle: NDArray[np.int64],
    cluster_handle: NDArray[np.int64],
    sight_handle: NDArray[np.int64],
) -> tuple[bool, int, int, int]:
    """Merge the hits and the free part of a scan into rows: the paper's Algorithm 1, online.

    Args:
        new: whether to begin with the scan, and not to go on with it in arrays that have grown.
        ranges_m, pose, angles_rad, limits_m: see `sight.see`.
        numbers: the `Rules`. segments: whether free evidence is segments and not areas.
        row_handle, tile_handle, cluster_handle, sight_handle: see `gpom_core.handles`.

    Returns:
        Whether all is done, and then its hits, its new rows, and how many clusters are too long; if
        not, the sight says what is needed to go on.
    """
    rules = Rules(*numbers)
    rows, tiles, clusters = rows_at(row_handle), tiles_at(tile_handle), clusters_at(cluster_handle)
    sight = sight_at(sight_handle)
    p = sight.progress
    if new:
        if p[STAGE] != _DONE:  # the last scan was given up halfway, for want of memory
            sight.crossed_m[:], sight.last[:] = 0.0, NONE
        p[STAGE], p[WINDOW], p[TILE] = _SEE, 0, NONE
        p[ROWS_BEFORE], p[CLUSTERS_BEFORE] = rows.size[0], clusters.size[0]
    if p[STAGE] == _SEE:
        n = len(ranges_m)
        if _lacks(sight, rows, tiles, clusters, n, n, n + 1) or n > len(sight.free_m):
            return False, 0, 0, 0
        see(ranges_m, pose, angles_rad, limits_m, rules, rows, tiles, clusters, sight)
        p[STAGE] = _DIVIDE
    if p[STAGE] == _DIVIDE:
        if tiles.size[CLOSE] > 0:
            if _lacks(sight, rows, tiles, clusters, tiles.size[CLOSE] * TILE_AREA, 0, 0):
                return False, 0, 0, 0
            divide_close(rows, tiles, clusters, rules.cell_m, rules.near_surface_m)
        p[STAGE] = _COUNT
    if p[STAGE] == _COUNT:
        if segments:
            counted = _count_segments(sight, rules, rows, tiles, clusters)
        else:
            counted = _count_areas(sight, rules, rows, tiles, clusters)
        if not counted:
            return False, 0, 0, 0
        p[STAGE] = _DONE
    _forget_unused(clusters, p[CLUSTERS_BEFORE])
    return True, p[HITS], rows.size[0] - p[ROWS_BEFORE], p[LONG]


@compiled
def _lacks(
    sight: Sight, rows: Rows, tiles: Tiles, clusters: Clusters,
    new_rows: int, new_tiles: int, new_clusters: int,
) -> bool:  # fmt: skip
    """Whether there is no room for so many more; if so, that is what is needed."""
    needed = sight.progress[NEEDED:]
    needed[0], needed[1], needed[2] = new_rows, new_tiles, new_clusters
    return bool(
        rows.size[0] + new_rows > len(rows.keys)
        or tiles.size[0] + new_tiles > len(tiles.keys)
        or clusters.size[0] + new_clusters > len(clusters.head)
    )


@compiled
def _count_areas(sight: Sight, rules: Rules, rows: Rows, tiles: Tiles, clusters: Clusters) -> bool:
    """Count the free part of beams in the cells that they cross; False if there is no room."""
    p, beams = sight.progress, sight.progress[BEAMS]
    direction, free_m, homes = sight.direction[:beams], sight.free_m[:beams], sight.homes[:beams]
    _, _, nx, ny = span(sight.origin, direction, free_m, rules.cell_m)
    p[NEEDED + 3] = window_room((nx, ny))
    if p[NEEDED + 3] > len(sight.last):
        return False
    p[WINDOW], p[TILE] = absorb_free_areas(
        (p[WINDOW], p[TILE]), sight.origin, direction, free_m, homes, sight.crossed_m, sight.last,
        rows, tiles, clusters, rules.cell_m, rules.near_surface_m,
        rules.coarse_levels >= TILE_SHIFT, rules.free_cap, rules.hit_cap,
        (rules.free_noise_std / rules.hit_noise_std) ** 2,
    )  # fmt: skip
    return p[WINDOW] == NONE or not _lacks(sight, rows, tiles, clusters, TILE_AREA, 1, 1)


@compiled
def _count_segments(
    sight: Sight, rules: Rules, rows: Rows, tiles: Tiles, clusters: Clusters
) -> bool:
    """Cut the free part of beams into segments; False if there is no room."""
    beams = sight.progress[BEAMS]
    pieces = 0
    for b in range(beams):
        pieces += int(np.ceil(max(sight.free_m[b], 0.0) / rules.segment_m))
    if _lacks(sight, rows, tiles, clusters, pieces, 0, 0):
        return False
    absorb_free_segments(
        sight.origin, sight.direction[:beams], sight.free_m[:beams], sight.homes[:beams],
        rows, clusters, rules.segment_m, 0.5 * rules.segment_m, rules.free_cap,
    )  # fmt: skip
    return True


@compiled
def _forget_unused(clusters: Clusters, before: int) -> None:
    """Give back the numbers of clusters founded in vain: all they saw was known already."""
    size = clusters.size[0]
    while size > before and clusters.rows[size - 1] == 0:
        size -= 1
    clusters.size[0] = size
