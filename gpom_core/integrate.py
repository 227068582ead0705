"""A scan into evidence in one call of compiled code, which stops where arrays have to grow."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from gpom_core.areas import absorb_free_areas
from gpom_core.clusters import clusters_at
from gpom_core.jit import compiled, inlined
from gpom_core.open_space import divide_close
from gpom_core.rows import NONE, rows_at
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
    see,
    sight_at,
)
from gpom_core.tiles import CLOSE, TILE_AREA, TILE_SHIFT, tiles_at
from gpom_core.walk import span, window_room

SEE, DIVIDE, COUNT, SEGMENTS, DONE = range(5)  # stages, in `progress[STAGE]`


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
        numbers: the `Rules`. segments: whether the caller cuts the free part into segments when
            stage `SEGMENTS` is reached; else it is counted as areas.
        row_handle, tile_handle, cluster_handle, sight_handle: see `gpom_core.handles`.

    Returns:
        Whether all is done, and then its hits, its new rows, and how many clusters are too long; if
        not, the sight says what is needed to go on.
    """
    rules = Rules(*numbers)
    rows, tiles, clusters = rows_at(row_handle), tiles_at(tile_handle), clusters_at(cluster_handle)
    sight = sight_at(sight_handle)
    p = sight.progress
    room = (
        len(rows.keys) - rows.size[0],
        len(tiles.keys) - tiles.size[0],
        len(clusters.head) - clusters.size[0],
        len(sight.last),
    )
    if new:
        if p[STAGE] != DONE:  # the last scan was given up halfway, for want of memory
            sight.crossed_m[:], sight.last[:] = 0.0, NONE
        p[STAGE], p[WINDOW], p[TILE] = SEE, 0, NONE
        p[ROWS_BEFORE], p[CLUSTERS_BEFORE] = rows.size[0], clusters.size[0]
    if p[STAGE] == SEE:
        n = len(ranges_m)
        if _lacks(p, room, (n, n, n + 1, 0)) or n > len(sight.free_m):
            return False, 0, 0, 0
        see(ranges_m, pose, angles_rad, limits_m, rules, rows, tiles, clusters, sight)
        room = len(rows.keys) - rows.size[0], room[1], room[2], room[3]
        p[STAGE] = DIVIDE
    if p[STAGE] == DIVIDE:
        if tiles.size[CLOSE] > 0:
            if _lacks(p, room, (tiles.size[CLOSE] * TILE_AREA, 0, 0, 0)):
                return False, 0, 0, 0
            divide_close(rows, tiles, clusters, rules.cell_m, rules.near_surface_m)
        p[STAGE] = SEGMENTS if segments else COUNT
        if segments:
            return False, 0, 0, 0
    if p[STAGE] == COUNT:
        beams = p[BEAMS]
        direction, free_m = sight.direction[:beams], sight.free_m[:beams]
        tx, ty, nx, ny = span(sight.origin, direction, free_m, rules.cell_m)
        if _lacks(p, room, (0, 0, 0, window_room((nx, ny)))):
            return False, 0, 0, 0
        p[WINDOW], p[TILE] = absorb_free_areas(
            (p[WINDOW], p[TILE]), (tx, ty, nx, ny), sight.origin, direction, free_m,
            sight.homes, sight.crossed_m, sight.last, rows, tiles, clusters,
            rules.cell_m, rules.near_surface_m, rules.coarse_levels >= TILE_SHIFT,
            rules.free_cap, rules.hit_cap, (rules.free_noise_std / rules.hit_noise_std) ** 2,
        )  # fmt: skip
        if p[WINDOW] != NONE:
            _lacks(p, room, (TILE_AREA, 1, 1, 0))
            return False, 0, 0, 0
    p[STAGE] = DONE
    size = clusters.size[0]
    while size > p[CLUSTERS_BEFORE] and clusters.rows[size - 1] == 0:
        size -= 1  # founded in vain: all that it saw was known already
    clusters.size[0] = size
    return True, p[HITS], rows.size[0] - p[ROWS_BEFORE], p[LONG]


@inlined
def _lacks(
    progress: NDArray[np.int64],
    room: tuple[int, int, int, int],
    needed: tuple[int, int, int, int],
) -> bool:
    """Whether there is no room for so many rows, tiles, clusters and tiles of the window.

    The progress says what is needed.
    """
    lacks = False
    for i in range(4):
        progress[NEEDED + i] = needed[i]
        lacks |= needed[i] > room[i]
    return lacks
