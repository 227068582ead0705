"""Beams of a scan in the map frame, and their free part into free segments."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from gpom_core.clusters import Clusters, shift
from gpom_core.jit import compiled
from gpom_core.rows import SEGMENT, Rows, attach, cell_key, find_or_add


class Beams(NamedTuple):
    """The n beams of a scan that say something, in the map frame, metres.

    Attributes:
        direction: (n, 2) unit.
        length_m: (n,) to the hit, or as far as the beam is known to be free.
        returned: (n,) whether there was a hit.
        hits: (h, 2) ends of the beams that returned, in their order.
        spacing_m: (h,) distance that one angular step spans at each hit.
    """

    direction: NDArray[np.float64]
    length_m: NDArray[np.float64]
    returned: NDArray[np.bool_]
    hits: NDArray[np.float64]
    spacing_m: NDArray[np.float64]


@compiled
def beams_of(
    ranges_m: NDArray[np.float32],
    pose: tuple[float, float],
    angles_rad: tuple[float, float],
    limits_m: tuple[float, float, float],
    direction: NDArray[np.float64],
    length_m: NDArray[np.float64],
) -> Beams:
    """Beams that returned, and those known to be free.

    Args:
        ranges_m: (n,) as REP 117.
        pose: of the sensor, x and y. angles_rad: of the first beam in the map frame, and the step.
        limits_m: nearest and farthest hit, compared as float32, as they travel; and where beams
            are cut: a hit beyond says that all before it is free.
        direction: (>= n, 2), length_m: (>= n,) room for those of the beams.
    """
    n = len(ranges_m)
    (x_m, y_m), (first_rad, step_rad), limit_m = pose, angles_rad, limits_m[2]
    returned, hits, spacing_m = np.empty(n, np.bool_), np.empty((n, 2)), np.empty(n)
    nearest, farthest = np.float32(limits_m[0]), np.float32(limits_m[1])
    used, back = 0, 0
    for i in range(n):
        r = ranges_m[i]
        hit = nearest <= r <= farthest
        if not (hit or r == np.inf):
            continue
        hit = hit and r <= limit_m
        length = float(r) if hit else limit_m
        angle = first_rad + step_rad * i
        ux, uy = np.cos(angle), np.sin(angle)
        direction[used, 0], direction[used, 1] = ux, uy
        length_m[used], returned[used] = length, hit
        used += 1
        if hit:
            hits[back, 0], hits[back, 1] = x_m + length * ux, y_m + length * uy
            spacing_m[back] = length * abs(step_rad)
            back += 1
    return Beams(direction[:used], length_m[:used], returned[:used], hits[:back], spacing_m[:back])


@compiled
def absorb_free_segments(
    origin: NDArray[np.float64],
    direction: NDArray[np.float64],
    free_m: NDArray[np.float64],
    homes: NDArray[np.int32],
    rows: Rows,
    clusters: Clusters,
    segment_m: float,
    end_cell_m: float,
    cap: float,
) -> None:
    """Cut the free part of beams into segments and merge those with the same pair of end cells.

    A beam's segments belong to the beam's cluster; one that is known stays with its cluster. The
    caller has made room for all segments.

    Args:
        origin: (2,) sensor. direction: (n, 2) unit. free_m: (n,) length of each free part.
        homes: (n,) cluster of each beam. segment_m: longest segment.
    """
    for b in range(len(free_m)):
        length = free_m[b]
        if not length > 0.0:
            continue
        pieces = int(np.ceil(length / segment_m))
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
                rows.kind[row] = SEGMENT
                rows.geometry[row, 0, 0] = ax
                rows.geometry[row, 0, 1] = ay
                rows.geometry[row, 1, 0] = bx
                rows.geometry[row, 1, 1] = by
                rows.near[row] = np.inf
                attach(
                    rows.owner, rows.before, rows.after, clusters.head, clusters.rows, row, homes[b]
                )
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
            if rows.count[row] < cap:
                clusters.gain[rows.owner[row]] += shift(rows.count[row], part, 0.0)
            rows.count[row] += part
