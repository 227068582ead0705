"""What one scan says about surfaces: its beams, whose hits they are, merged into rows."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import carray
from numpy.typing import NDArray

from gpom_core.beams import beams_of
from gpom_core.clusters import Clusters, add_cluster, associate, longer_than
from gpom_core.jit import compiled
from gpom_core.lines import track_lines
from gpom_core.pointers import pointer
from gpom_core.rows import NONE, Rows
from gpom_core.similarity import most_similar
from gpom_core.surfaces import absorb_hits
from gpom_core.tiles import TILE_AREA, Tiles

BEAMS, HITS, LONG, STAGE, WINDOW, TILE, ROWS_BEFORE, CLUSTERS_BEFORE = range(8)
NEEDED = 8  # and the three that follow: rows, tiles, clusters, tiles of the window


class Rules(NamedTuple):
    """The numbers of `gpom_core.config` that say how scans become evidence, under their names."""

    cell_m: float
    hit_cell_m: float
    hit_margin_m: float
    near_surface_m: float
    line_tolerance_m: float
    line_gap_m: float
    max_length_m: float
    length_scale_m: float
    hit_noise_std: float
    free_noise_std: float
    hit_cap: float
    free_cap: float
    coarse_levels: float


class Sight(NamedTuple):
    """One scan on its way into the map: n beams and a window of w tiles, with room for more.

    Attributes:
        origin: (2,) the sensor. direction: (n, 2) unit. free_m: (n,) length of the free part.
        homes: (n,) cluster of each beam.
        long: clusters among them that outgrew `max_length_m`, each once, in order.
        crossed_m: (64 w,), last: (w,) see `walk.Crossed`; 0 and NONE between scans.
        progress: (12,) how many `BEAMS`, `HITS` and `LONG` there are; how far it is counted; how
            many rows, tiles, clusters and tiles of the window are `NEEDED` to go on.
    """

    origin: NDArray[np.float64]
    direction: NDArray[np.float64]
    free_m: NDArray[np.float64]
    homes: NDArray[np.int32]
    long: NDArray[np.int32]
    crossed_m: NDArray[np.float64]
    last: NDArray[np.int32]
    progress: NDArray[np.int64]


def new_sight(beams: int = 512, window: int = 1024) -> Sight:
    """Room for so many beams and a window of so many tiles."""
    return Sight(
        origin=np.zeros(2),
        direction=np.zeros((beams, 2)),
        free_m=np.zeros(beams),
        homes=np.zeros(beams, np.int32),
        long=np.zeros(beams, np.int32),
        crossed_m=np.zeros(window * TILE_AREA),
        last=np.full(window, NONE, np.int32),
        progress=np.zeros(NEEDED + 4, np.int64),
    )


def with_room(sight: Sight, beams: int, window: int) -> Sight:
    """`sight`, or a copy with room for so many beams and tiles of the window, which is empty."""
    b, w = len(sight.free_m), len(sight.last)
    if beams <= b and window <= w:
        return sight
    grown = new_sight(b if beams <= b else 2 * beams, w if window <= w else 2 * window)
    for name in ("direction", "free_m", "homes", "long"):
        getattr(grown, name)[:b] = getattr(sight, name)
    for name in ("origin", "progress"):
        getattr(grown, name)[:] = getattr(sight, name)
    return grown


@compiled
def sight_at(handle: NDArray[np.int64]) -> Sight:
    """The sight behind a handle, see `gpom_core.handles`."""
    beams = handle[2, 1]
    return Sight(
        carray(pointer(handle[0, 0]), 2, np.float64),
        carray(pointer(handle[1, 0]), (beams, 2), np.float64),
        carray(pointer(handle[2, 0]), beams, np.float64),
        carray(pointer(handle[3, 0]), beams, np.int32),
        carray(pointer(handle[4, 0]), beams, np.int32),
        carray(pointer(handle[5, 0]), handle[5, 1], np.float64),
        carray(pointer(handle[6, 0]), handle[6, 1], np.int32),
        carray(pointer(handle[7, 0]), handle[7, 1], np.int64),
    )


@compiled
def see(
    ranges_m: NDArray[np.float32],
    pose: tuple[float, float],
    angles_rad: tuple[float, float],
    limits_m: tuple[float, float, float],
    rules: Rules,
    rows: Rows,
    tiles: Tiles,
    clusters: Clusters,
    sight: Sight,
) -> None:
    """Track the hits of a scan into lines, give the lines to clusters, merge the hits into rows.

    The caller has made room for n beams, rows and tiles and n + 1 clusters.

    Args:
        ranges_m: (n,) as REP 117.
        pose: of the sensor, x and y. angles_rad: of the first beam in the map frame, and the step.
        limits_m: range_min, range_max, and where beams are cut.
        sight: filled with what was seen, but for what was crossed.
    """
    beams = beams_of(ranges_m, pose, angles_rad, limits_m, sight.direction, sight.free_m)
    hits, returned, length_m = beams.hits, beams.returned, beams.length_m
    starts = track_lines(hits, beams.spacing_m, rules.line_tolerance_m, rules.line_gap_m)
    owners = associate(hits, starts, rows, tiles, clusters, rules.cell_m, rules.line_tolerance_m)
    absorb_hits(
        hits, owners, rows, tiles, clusters,
        rules.hit_cell_m, rules.cell_m, rules.near_surface_m, rules.hit_cap, rules.free_cap,
        (rules.free_noise_std / rules.hit_noise_std) ** 2,
    )  # fmt: skip
    long = longer_than(clusters, owners, rules.max_length_m)
    n, homes = len(returned), sight.homes
    if 0 < len(hits) < n:
        # By the segment-segment kernel (section 3.1 of the paper).
        ends = length_m.reshape(n, 1) * beams.direction
        like = most_similar(ends, returned, rules.length_scale_m)
    h = 0
    for b in range(n):
        if returned[b]:
            homes[b] = owners[h]
            length_m[b] -= rules.hit_margin_m
            h += 1
    if 0 < h < n:
        for b in range(n):
            homes[b] = homes[like[b]]
    elif h < n:
        homes[:n] = add_cluster(clusters, pose[0], pose[1])
    sight.origin[0], sight.origin[1] = pose
    sight.long[: len(long)] = long
    sight.progress[BEAMS], sight.progress[HITS], sight.progress[LONG] = n, h, len(long)
