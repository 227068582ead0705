"""What one scan says about surfaces: its beams, whose hits they are, merged into rows."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from gpom_core.beams import beams_of
from gpom_core.clusters import Clusters, add_cluster, associate, longer_than
from gpom_core.jit import compiled
from gpom_core.lines import track_lines
from gpom_core.rows import Rows
from gpom_core.similarity import most_similar
from gpom_core.surfaces import absorb_hits
from gpom_core.tiles import Tiles


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


class Sight(NamedTuple):
    """The n beams of a scan after its hits were merged.

    Attributes:
        hits: how many beams returned.
        origin: (2,) the sensor. direction: (n, 2) unit. free_m: (n,) length of the free part.
        homes: (n,) cluster of each beam.
        long: clusters among them that outgrew `max_length_m`, each once, in order.
    """

    hits: int
    origin: NDArray[np.float64]
    direction: NDArray[np.float64]
    free_m: NDArray[np.float64]
    homes: NDArray[np.int32]
    long: NDArray[np.int32]


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
) -> Sight:
    """Track the hits of a scan into lines, give the lines to clusters, merge the hits into rows.

    The caller has made room for n rows and tiles and n + 1 clusters. In one piece, as each call of
    compiled code costs 2 µs to hand over rows, tiles and clusters.

    Args:
        ranges_m: (n,) as REP 117.
        pose: of the sensor, x and y. angles_rad: of the first beam in the map frame, and the step.
        limits_m: range_min, range_max, and where beams are cut.
    """
    beams = beams_of(ranges_m, pose, angles_rad, limits_m)
    hits, returned = beams.hits, beams.returned
    starts = track_lines(hits, beams.spacing_m, rules.line_tolerance_m, rules.line_gap_m)
    owners = associate(hits, starts, rows, tiles, clusters, rules.cell_m, rules.line_tolerance_m)
    absorb_hits(
        hits, owners, rows, tiles, clusters,
        rules.hit_cell_m, rules.cell_m, rules.near_surface_m, rules.hit_cap, rules.free_cap,
        (rules.free_noise_std / rules.hit_noise_std) ** 2,
    )  # fmt: skip
    long = longer_than(clusters, owners, rules.max_length_m)
    n = len(returned)
    homes, free_m = np.empty(n, np.int32), beams.length_m.copy()
    back = np.flatnonzero(returned)
    homes[back] = owners
    free_m[back] -= rules.hit_margin_m
    if 0 < len(back) < n:
        # By the segment-segment kernel (section 3.1 of the paper).
        ends = beams.length_m.reshape(n, 1) * beams.direction
        like = most_similar(ends, returned, rules.length_scale_m)
        for b in range(n):
            homes[b] = homes[like[b]]
    elif len(back) < n:
        homes[:] = add_cluster(clusters, pose[0], pose[1])
    return Sight(len(hits), beams.origin, beams.direction, free_m, homes, long)
