"""Whether an expert has to learn anew: how far the means at its places are from what it learned."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from gpom_core.clusters import Clusters
from gpom_core.jit import compiled, inlined
from gpom_core.rows import BOX, COORDINATE_BITS, NONE, POINT, Rows, cell_key, find
from gpom_core.tiles import TILE_CELLS, TILE_SHIFT, Tiles, place_in_tile

SURPRISE = 0.3  # of a mean between -1 and 1; off by more where evidence is at odds is news alone


@compiled
def judge(
    suspects: NDArray[np.int64], rows: Rows, tiles: Tiles, clusters: Clusters,
    cell_m: float, hit_cap: float, free_cap: float, hit_weight: float, limit: float,
) -> None:  # fmt: skip
    """Settle the `gain` of clusters (n,), which adds up every move of a mean, there and back.

    Those whose means are off by more than `limit` on average, or by a surprise in one place, are
    dirty; the gain of all others is what is left of their moves.
    """
    for c in suspects:
        total, largest = _off(c, rows, tiles, clusters, cell_m, hit_cap, free_cap, hit_weight)
        if largest > SURPRISE or total > limit * clusters.rows[c]:
            clusters.fresh[c] += 1
        else:
            clusters.gain[c] = total


@compiled
def _off(
    c: int, rows: Rows, tiles: Tiles, clusters: Clusters,
    cell_m: float, hit_cap: float, free_cap: float, hit_weight: float,
) -> tuple[float, float]:  # fmt: skip
    """How far the means at the places of a cluster are from what it learned.

    The sum, and the largest among the places where something speaks for both.
    What belongs to other clusters speaks for or against as it does now: those learn it on their
    own. Whole tiles are rarely asked for one place, and nothing contradicts them.
    """
    kind, keys, count, learned, owner = rows.kind, rows.keys, rows.count, rows.learned, rows.owner
    geometry, free, hits = rows.geometry, tiles.free, tiles.hit
    offset, mask = 1 << (COORDINATE_BITS - 1), (1 << COORDINATE_BITS) - 1
    total, largest = 0.0, 0.0
    row = clusters.head[c]
    while row != NONE:
        hit = kind[row] == POINT
        own, weight, cap, other_cap = 1.0, 1.0 / hit_weight, free_cap, hit_cap
        other = NONE
        if hit:
            ix = int(np.floor(geometry[row, 0, 0] / cell_m))
            iy = int(np.floor(geometry[row, 0, 1] / cell_m))
            weight, cap, other_cap = hit_weight, hit_cap, free_cap
        else:
            ix = ((keys[row, 0] >> COORDINATE_BITS) & mask) - offset
            iy = (keys[row, 0] & mask) - offset
        if rows.crossed[row] > 0:
            own = 1.0 / TILE_CELLS
        elif hit or kind[row] == BOX:
            tile = find(tiles.slots, tiles.keys, cell_key(0, ix >> TILE_SHIFT, iy >> TILE_SHIFT), 0)
            if tile != NONE:
                other = (free if hit else hits)[tile, place_in_tile(ix, iy)]
        against, against_then = 0.0, 0.0
        if other != NONE:
            against = min(count[other], other_cap) / weight
            against_then = against
            if owner[other] == c:
                against_then = min(learned[other], other_cap) / weight
        now = _mean(min(count[row] * own, cap), against)
        off = abs(now - _mean(min(learned[row] * own, cap), against_then))
        total += off
        if against > 0.0:
            largest = max(largest, off)
        row = rows.after[row]
    return total, largest


@inlined
def _mean(count: float, against: float) -> float:
    """Mean at a place on its own: see `clusters.shift`."""
    return (count - against) / (count + against + 1.0)
