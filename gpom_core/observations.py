"""Observations of one expert: what was seen where, merged, as frozen arrays."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from gpom_core.clusters import Clusters
from gpom_core.jit import compiled, inlined
from gpom_core.lines import moments_of, principal_axis
from gpom_core.rows import BOX, COORDINATE_BITS, POINT, Rows
from gpom_core.tiles import TILE_AREA, TILE_SHIFT

OCCUPIED, FREE = 1.0, -1.0
LEAST_COUNT = 1e-3  # a beam that grazes a cell; less is not worth a different noise
UNSEEN = 0.1  # of the prior variance: what a beam through a tile leaves open about its average


@dataclass(frozen=True, slots=True, eq=False)
class Observations:
    """What one expert is trained on; n observations in d dimensions.

    Attributes:
        kinds: (n,) uint8, see `gpom_core.shapes.Kind`.
        geometry: (n, 2, d) metres: point twice, segment's ends, or box's low and high corner.
        targets: (n,) +1 for hits, -1 for what is free.
        noise_variance: (n,) of the merged target.
        count: (n,) how many observations were merged.
    """

    kinds: NDArray[np.uint8]
    geometry: NDArray[np.float64]
    targets: NDArray[np.float64]
    noise_variance: NDArray[np.float64]
    count: NDArray[np.float64]

    def __post_init__(self) -> None:
        n = len(self.kinds)
        for name in ("targets", "noise_variance", "count"):
            if getattr(self, name).shape != (n,):
                raise ValueError(
                    f"{name} has shape {getattr(self, name).shape}, expected ({n},) like kinds"
                )
        if self.geometry.ndim != 3 or self.geometry.shape[:2] != (n, 2):
            raise ValueError(f"geometry has shape {self.geometry.shape}, expected ({n}, 2, d)")

    def __len__(self) -> int:
        return len(self.kinds)


class Weighing(NamedTuple):
    """The numbers of `gpom_core.config` that say what evidence weighs, under their names."""

    cell_m: float
    coarse_levels: int
    coarsen_ratio: float
    hit_noise_std: float
    free_noise_std: float
    hit_cap: float
    free_cap: float
    signal_std: float


class Seen(NamedTuple):
    """The arrays of `Observations` of one cluster, and what else training wants to know.

    Attributes:
        line: (2, 2) ends of the line of its hits; its origin twice if it has none.
        often: how many beams went through a free area, on average; 0 if there are none.
        far: share of the free area that is tiles in the open; 0 if there is none.
    """

    kinds: NDArray[np.uint8]
    geometry: NDArray[np.float64]
    targets: NDArray[np.float64]
    noise_variance: NDArray[np.float64]
    count: NDArray[np.float64]  # type: ignore[assignment] # nobody counts values of this tuple
    line: NDArray[np.float64]
    often: float
    far: float

    def observations(self) -> Observations:
        """Only those."""
        return Observations(
            self.kinds, self.geometry, self.targets, self.noise_variance, self.count
        )


@compiled
def observe(rows: Rows, clusters: Clusters, c: int, weighing: Weighing) -> Seen:
    """What cluster `c` is trained on, in one piece: free areas merged where no surface is near.

    Its rows note that they were learned as they are.

    Observations are in the order of their places, whatever order they came in.
    """
    n = int(clusters.rows[c])
    mine, key, other = np.empty(n, np.int64), np.empty(n, np.int64), np.empty(n, np.int64)
    box_key, box_count, box_near = np.empty(n, np.int64), np.empty(n), np.empty(n)
    whole = np.empty(n, np.bool_)
    row, used, areas = int(clusters.head[c]), 0, 0
    for _ in range(n):
        crossed = int(rows.crossed[row])
        rows.learned[row] = rows.count[row]
        if rows.kind[row] == BOX and crossed % TILE_AREA == 0:  # a cell, or all of a tile
            box_key[areas], box_count[areas] = rows.keys[row, 0], rows.count[row]
            box_near[areas], whole[areas] = rows.near[row], crossed > 0
            areas += 1
        else:
            mine[used], key[used], other[used] = row, rows.keys[row, 0], rows.keys[row, 1]
            used += 1
        row = int(rows.after[row])
    order = _order(key[:used], other[:used])
    box, box_total, box_weight, box_whole = merge_areas(
        box_key[:areas], box_count[:areas], box_near[:areas], whole[:areas],
        weighing.cell_m, weighing.coarse_levels, weighing.coarsen_ratio, weighing.free_cap,
    )  # fmt: skip
    n = used + len(box_total)
    kinds, geometry, targets = np.empty(n, np.uint8), np.empty((n, 2, 2)), np.empty(n)
    noise, count = np.empty(n), np.empty(n)
    hits, area, passed, far = 0, 0.0, 0.0, 0.0
    for i in range(n):
        kind, weight, unseen, place, crossed = BOX, 0.0, 0.0, box, 0
        at = i - used
        if at >= 0:
            count[i], weight, crossed = box_total[at], box_weight[at], int(box_whole[at])
        else:
            at, place = mine[order[i]], rows.geometry
            kind, count[i], crossed = int(rows.kind[at]), rows.count[at], int(rows.crossed[at])
            cap = weighing.hit_cap if kind == POINT else weighing.free_cap * max(crossed, 1)
            weight = min(count[i], cap)
            if crossed > 0:
                unseen = UNSEEN * weighing.signal_std**2
                unseen *= max(_area(place, at) / weighing.cell_m**2 - crossed, 0.0) / TILE_AREA
        kinds[i] = kind
        for end in range(2):
            for axis in range(2):
                geometry[i, end, axis] = place[at, end, axis]
        std = weighing.hit_noise_std if kind == POINT else weighing.free_noise_std
        noise[i] = std * std / max(weight, LEAST_COUNT) + unseen
        targets[i] = OCCUPIED if kind == POINT else FREE
        hits += kind == POINT
        if kind == BOX:
            passed += count[i]
            area += _area(geometry, i)
            far += _area(geometry, i) if crossed > 0 else 0.0
    often = passed * weighing.cell_m**2 / area if area > 0.0 else 0.0
    far = far / area if area > 0.0 else 0.0
    line = _line(geometry, hits, clusters.origin, c)  # hits come first, by their keys
    return Seen(kinds, geometry, targets, noise, count, line, often, far)


@compiled
def _order(key: NDArray[np.int64], other: NDArray[np.int64]) -> NDArray[np.int64]:
    """Numbers of rows in order of their two keys (n,) each."""
    first = np.argsort(other, kind="mergesort")
    sorted_key = np.empty(len(key), np.int64)
    for i in range(len(key)):
        sorted_key[i] = key[first[i]]
    order = np.argsort(sorted_key, kind="mergesort")
    for i in range(len(key)):
        order[i] = first[order[i]]
    return order


@inlined
def _area(geometry: Any, i: int) -> float:
    return float((geometry[i, 1, 0] - geometry[i, 0, 0]) * (geometry[i, 1, 1] - geometry[i, 0, 1]))


@compiled
def _line(
    geometry: NDArray[np.float64], hits: int, origin: NDArray[np.float64], c: int
) -> NDArray[np.float64]:
    """Ends (2, 2) of the line through the first `hits` places; the origin of cluster `c` if 0."""
    ends, xy = np.empty((2, 2)), np.empty((hits, 2))
    moments = np.zeros(6)
    x, y = origin[c, 0], origin[c, 1]
    tx, ty, low, high = 1.0, 0.0, 0.0, 0.0
    if hits > 0:
        x, y = geometry[0, 0, 0], geometry[0, 0, 1]
        for i in range(hits):
            xy[i, 0], xy[i, 1] = geometry[i, 0, 0] - x, geometry[i, 0, 1] - y
        moments_of(xy, moments)
        cx, cy, tx, ty, _, _ = principal_axis(moments)
        x, y = x + cx, y + cy
        low, high = np.inf, -np.inf
        for i in range(hits):
            along = (xy[i, 0] - cx) * tx + (xy[i, 1] - cy) * ty
            low, high = min(low, along), max(high, along)
    ends[0, 0], ends[0, 1] = x + low * tx, y + low * ty
    ends[1, 0], ends[1, 1] = x + high * tx, y + high * ty
    return ends


@compiled
def merge_areas(
    key: NDArray[np.int64],
    count: NDArray[np.float64],
    near: NDArray[np.float64],
    whole: NDArray[np.bool_],
    cell_m: float,
    levels: int,
    coarsen_ratio: float,
    cap: float,
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64], NDArray[np.bool_]]:
    """Merge free areas four by four into coarser ones where no surface is near.

    Four known quarters are merged when their nearest hit is farther than `coarsen_ratio` of their
    edges, so that fine areas remain where the map bends. Along a Morton curve the four follow each
    other, on every level.

    Args:
        key: (n,) lattice keys. count: (n,). near: (n,) distance to the nearest hit.
        whole: (n,) whether it is a tile already, all cells of which were crossed.

    Returns:
        geometry (m, 2, 2), and (m,) the sums of the counts, as they are and each capped at `cap`,
        and whether all of it is `whole` tiles.
    """
    n = len(key)
    code = np.empty(n, np.int64)
    for i in range(n):
        code[i] = (_spread(key[i] >> COORDINATE_BITS) << 1) | _spread(key[i])
    order = np.argsort(code, kind="mergesort")
    level, low = np.empty(n, np.int64), np.empty((n, 2), np.int64)
    nearest, total, capped = np.empty(n), np.empty(n), np.empty(n)
    open_ = np.empty(n, np.bool_)
    offset, mask = 1 << (COORDINATE_BITS - 1), (1 << COORDINATE_BITS) - 1
    m = 0
    for i in order:
        level[m] = TILE_SHIFT if whole[i] else 0
        low[m, 0] = ((key[i] >> COORDINATE_BITS) & mask) - offset
        low[m, 1] = (key[i] & mask) - offset
        nearest[m], total[m], open_[m] = near[i], count[i], whole[i]
        capped[m] = min(count[i], cap * TILE_AREA if whole[i] else cap)
        m += 1
        while m >= 4:  # the last four, if they are one square
            at, up = level[m - 1], level[m - 1] + 1
            first = m - 4
            edge = 1 << at
            same = at < levels
            for j in range(first, m):
                same &= level[j] == at
                same &= low[j, 0] >> up == low[first, 0] >> up
                same &= low[j, 1] >> up == low[first, 1] >> up
                same &= nearest[j] > coarsen_ratio * cell_m * edge
            if not same:
                break
            for j in range(first + 1, m):
                nearest[first] = min(nearest[first], nearest[j])
                total[first] += total[j]
                capped[first] += capped[j]
                open_[first] &= open_[j]
            level[first] = up
            m = first + 1
    geometry = np.empty((m, 2, 2))
    for i in range(m):
        edge = 1 << level[i]
        for axis in range(2):
            geometry[i, 0, axis] = low[i, axis] * cell_m
            geometry[i, 1, axis] = (low[i, axis] + edge) * cell_m
    return geometry, total[:m], capped[:m], open_[:m]


@inlined
def _spread(index: int) -> int:
    """The bits of a cell index, each in every second place."""
    x = index & ((1 << COORDINATE_BITS) - 1)
    x = (x | (x << 16)) & 0x0000FFFF0000FFFF
    x = (x | (x << 8)) & 0x00FF00FF00FF00FF
    x = (x | (x << 4)) & 0x0F0F0F0F0F0F0F0F
    x = (x | (x << 2)) & 0x3333333333333333
    return (x | (x << 1)) & 0x5555555555555555
