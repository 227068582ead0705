"""Clusters on the map: which cluster a run of hits belongs to, and splitting those that outgrow.

A cluster is known here by its number, its list of rows and the moments of its hits. Numbers are
never used twice, so a result trained for a cluster that is gone can be told apart.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numba import carray
from numpy.typing import NDArray

from gpom_core.jit import compiled, inlined
from gpom_core.lines import principal_axis
from gpom_core.pointers import pointer
from gpom_core.rows import NONE, Rows, attach, cell_key, detach, find
from gpom_core.tiles import HIT, TILE_CELLS, TILE_SHIFT, Tiles, place_in_tile

MAX_CANDIDATES = 16  # clusters that one run can touch; more are not looked at
FEW_HITS = 3  # a run this short has no direction: it joins what is near
LENGTH_OF_VARIANCE = 12.0  # a uniform segment of length L has variance L²/12 along itself


class Clusters(NamedTuple):
    """Struct of arrays; `size[0]` clusters were ever made.

    Attributes:
        head, rows: (c,) first row of the list and its length.
        origin: (c, 2) first hit, metres.
        moments: (c, 6) of the hits' cells relative to `origin`: n, sx, sy, sxx, sxy, syy.
        gain: (c,) how far the means at its rows moved since the last training, see `shift`.
        fresh: (c,) rows that came or went since the last training, but for those that say little.
        revision: (c,) grows with every change of evidence that counts.
        size: (1,).
    """

    head: NDArray[np.int32]
    rows: NDArray[np.int32]
    origin: NDArray[np.float64]
    moments: NDArray[np.float64]
    gain: NDArray[np.float64]
    fresh: NDArray[np.int32]
    revision: NDArray[np.int64]
    size: NDArray[np.int64]


def new_clusters(capacity: int = 256) -> Clusters:
    """No clusters, with room for `capacity`."""
    return Clusters(
        head=np.full(capacity, NONE, np.int32),
        rows=np.zeros(capacity, np.int32),
        origin=np.zeros((capacity, 2)),
        moments=np.zeros((capacity, 6)),
        gain=np.zeros(capacity),
        fresh=np.zeros(capacity, np.int32),
        revision=np.zeros(capacity, np.int64),
        size=np.zeros(1, np.int64),
    )


@compiled
def clusters_at(handle: NDArray[np.int64]) -> Clusters:
    """The clusters behind a handle, see `gpom_core.handles`."""
    capacity = handle[0, 1]
    return Clusters(
        carray(pointer(handle[0, 0]), capacity, np.int32),
        carray(pointer(handle[1, 0]), capacity, np.int32),
        carray(pointer(handle[2, 0]), (capacity, 2), np.float64),
        carray(pointer(handle[3, 0]), (capacity, 6), np.float64),
        carray(pointer(handle[4, 0]), capacity, np.float64),
        carray(pointer(handle[5, 0]), capacity, np.int32),
        carray(pointer(handle[6, 0]), capacity, np.int64),
        carray(pointer(handle[7, 0]), 1, np.int64),
    )


def with_room(clusters: Clusters, extra: int) -> Clusters:
    """`clusters`, or a grown copy with room for `extra` more."""
    used, capacity = int(clusters.size[0]), len(clusters.head)
    if used + extra <= capacity:
        return clusters
    grown = new_clusters(max(2 * capacity, used + extra))
    for name in clusters._fields:
        getattr(grown, name)[:used] = getattr(clusters, name)[:used]
    grown.size[0] = used
    return grown


@compiled
def add_cluster(clusters: Clusters, x: float, y: float) -> int:
    """A new cluster whose first hit is (x, y). The caller has made room."""
    c = int(clusters.size[0])
    clusters.size[0] = c + 1
    clusters.origin[c, 0] = x
    clusters.origin[c, 1] = y
    return c


@compiled
def add_hit_moments(clusters: Clusters, c: int, x: float, y: float) -> None:
    """Count a hit cell at (x, y) in the line of cluster `c`."""
    dx, dy = x - clusters.origin[c, 0], y - clusters.origin[c, 1]
    m = clusters.moments[c]
    m[0] += 1.0
    m[1] += dx
    m[2] += dy
    m[3] += dx * dx
    m[4] += dx * dy
    m[5] += dy * dy


@inlined
def shift(count: float, added: float, against: float) -> float:
    """How far the mean at a place moves when `added` more say what `count` have said there.

    The place is taken on its own, under a prior worth one observation: its mean is
    (n - a) / (n + a + 1), where `against` says the opposite in units of the same weight. All
    shifts of a place that nothing contradicts add up to less than one, however often it is seen.
    """
    known = count + against + 1.0
    return added * (2.0 * against + 1.0) / (known * (known + added))


@compiled
def associate(
    xy: NDArray[np.float64],
    starts: NDArray[np.int64],
    rows: Rows,
    tiles: Tiles,
    clusters: Clusters,
    cell_m: float,
    tolerance_m: float,
) -> NDArray[np.int32]:
    """Cluster of every hit of a scan.

    Each run asks the cells in and around its hits which cluster has hits there. The
    cluster with most votes takes the run if the run lies on its line; a run that finds nobody
    founds a cluster. The caller has made room for one cluster per run.

    Args:
        xy: (n, 2) hits. starts: from `track_lines`.

    Returns:
        (n,) cluster numbers.
    """
    out = np.empty(len(xy), np.int32)
    names = np.empty(MAX_CANDIDATES, np.int32)
    votes = np.empty(MAX_CANDIDATES, np.float64)
    owner, slots, keys, used, hits = rows.owner, tiles.slots, tiles.keys, tiles.used, tiles.hit
    run = 0
    while starts[run] < len(xy):
        first, end = starts[run], starts[run + 1]
        few = end - first <= FEW_HITS
        found = _vote(
            xy[first:end], owner, slots, keys, used, hits, cell_m, 3 if few else 1, names, votes
        )
        chosen = NONE
        for _ in range(found):
            best = np.argmax(votes[:found])
            if votes[best] <= 0.0:
                break
            if few or _on_line(xy[first:end], clusters, names[best], tolerance_m):
                chosen = names[best]
                break
            votes[best] = 0.0
        if chosen == NONE:
            chosen = add_cluster(clusters, xy[first, 0], xy[first, 1])
        out[first:end] = chosen
        run += 1
    return out


@inlined
def _vote(
    xy: Any, owner: Any, slots: Any, keys: Any, used: Any, hits: Any,
    cell_m: float, reach: int, names: Any, votes: Any,
) -> int:  # fmt: skip
    """Fill `names` and `votes` with the clusters around the hits; how many were found.

    Takes arrays and not tuples of them, which would be counted as references in the inner loop.
    """
    found, i = 0, 0
    while i < len(xy):
        ix, iy = int(np.floor(xy[i, 0] / cell_m)), int(np.floor(xy[i, 1] / cell_m))
        weight = 1.0
        i += 1
        while (
            i < len(xy)
            and int(np.floor(xy[i, 0] / cell_m)) == ix
            and int(np.floor(xy[i, 1] / cell_m)) == iy
        ):
            weight += 1.0  # hits of one cell vote alike
            i += 1
        for tx in range((ix - reach) >> TILE_SHIFT, ((ix + reach) >> TILE_SHIFT) + 1):
            for ty in range((iy - reach) >> TILE_SHIFT, ((iy + reach) >> TILE_SHIFT) + 1):
                tile = find(slots, keys, cell_key(0, tx, ty), 0)
                if tile == NONE or used[tile, HIT] == 0:
                    continue
                x0, y0 = tx << TILE_SHIFT, ty << TILE_SHIFT
                for x in range(max(x0, ix - reach), min(x0 + TILE_CELLS, ix + reach + 1)):
                    for y in range(max(y0, iy - reach), min(y0 + TILE_CELLS, iy + reach + 1)):
                        hit = hits[tile, place_in_tile(x, y)]
                        if hit == NONE:
                            continue
                        k = 0
                        while k < found and names[k] != owner[hit]:
                            k += 1
                        if k == found:
                            if found == len(names):
                                continue
                            names[k], votes[k] = owner[hit], 0.0
                            found += 1
                        votes[k] += weight / (1.0 + (x - ix) ** 2 + (y - iy) ** 2)
    return found


@compiled
def _on_line(xy: Any, clusters: Clusters, c: int, tolerance_m: float) -> bool:
    """Whether the points lie on the line of cluster `c`, root mean square."""
    m = clusters.moments[c].copy()
    ox, oy = clusters.origin[c, 0], clusters.origin[c, 1]
    young = m[0] <= FEW_HITS
    if young:  # no line of its own yet: judge both together
        for i in range(len(xy)):
            x, y = xy[i, 0] - ox, xy[i, 1] - oy
            m += np.array([1.0, x, y, x * x, x * y, y * y])
    cx, cy, tx, ty, along, across = principal_axis(m)
    if young or along < 4.0 * tolerance_m * tolerance_m:
        return across <= tolerance_m * tolerance_m
    total = 0.0
    for i in range(len(xy)):
        off = (xy[i, 1] - oy - cy) * tx - (xy[i, 0] - ox - cx) * ty
        total += off * off
    return total <= tolerance_m * tolerance_m * len(xy)


@compiled
def longer_than(clusters: Clusters, among: NDArray[np.int32], limit_m: float) -> NDArray[np.int32]:
    """Those of the clusters `among` (n,) whose line is longer than `limit_m`, each once, sorted."""
    out = np.empty(len(among), np.int32)
    n = 0
    for i in range(len(among)):
        # hits of one cluster come in runs
        if (i == 0 or among[i] != among[i - 1]) and length_m(clusters, among[i]) > limit_m:
            at = n  # few if any: sorted as they come
            while at > 0 and out[at - 1] >= among[i]:
                at -= 1
            if at == n or out[at] != among[i]:
                out[at + 1 : n + 1] = out[at:n].copy()
                out[at] = among[i]
                n += 1
    return out[:n]


@compiled
def length_m(clusters: Clusters, c: int) -> float:
    """Length of the cluster's line, from the spread of its hits."""
    if clusters.moments[c, 0] < 2.0:
        return 0.0
    return float(np.sqrt(LENGTH_OF_VARIANCE * principal_axis(clusters.moments[c])[4]))


@compiled
def split(rows: Rows, clusters: Clusters, c: int, by_hits: bool) -> int:
    """Halve cluster `c` across its longest axis; the number of the new cluster, or NONE.

    With `by_hits` the axis and the cut are those of the hits' line, else those of all rows.
    Both halves keep their evidence; the caller marks them dirty and has made room for one more.
    """
    m = np.zeros(6)
    ox, oy = clusters.origin[c, 0], clusters.origin[c, 1]
    row = clusters.head[c]
    while row != NONE:
        if not by_hits or rows.kind[row] == 0:
            x = 0.5 * (rows.geometry[row, 0, 0] + rows.geometry[row, 1, 0]) - ox
            y = 0.5 * (rows.geometry[row, 0, 1] + rows.geometry[row, 1, 1]) - oy
            m += np.array([1.0, x, y, x * x, x * y, y * y])
        row = rows.after[row]
    if m[0] < 2.0:
        return NONE
    cx, cy, tx, ty, along, _ = principal_axis(m)
    if along <= 0.0:
        return NONE
    new = add_cluster(clusters, ox + cx, oy + cy)
    owner, before, after = rows.owner, rows.before, rows.after
    head, length = clusters.head, clusters.rows
    clusters.moments[c, :] = 0.0
    row = head[c]
    while row != NONE:
        following = after[row]
        x = 0.5 * (rows.geometry[row, 0, 0] + rows.geometry[row, 1, 0])
        y = 0.5 * (rows.geometry[row, 0, 1] + rows.geometry[row, 1, 1])
        home = c
        if (x - ox - cx) * tx + (y - oy - cy) * ty > 0.0:
            home = new
            detach(owner, before, after, head, length, row)
            attach(owner, before, after, head, length, row, new)
        if rows.kind[row] == 0:
            add_hit_moments(clusters, home, x, y)
        row = following
    return new
