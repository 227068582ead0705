"""A square of the map with the experts that reach into it, laid out for fast queries.

The arrays of the experts are not copied: the sector keeps their addresses, and the experts alive.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from llvmlite import ir
from numba import carray, types
from numba.extending import intrinsic
from numpy.typing import NDArray

from gpom_core.beams import BOX, POINT
from gpom_core.committee import contribution
from gpom_core.jit import compiled
from gpom_core.kernels import point_box, point_point, point_segment
from gpom_core.member import (
    GEOMETRY,
    KINDS,
    MEMBERS,
    PRECISION,
    SECTOR_M,
    SECTOR_TILES,
    SIZE,
    STARTS,
    TILE_COUNT,
    TILE_M,
    TILES,
    WEIGHTS,
    Member,
)
from gpom_core.reach import TILE_BITS, TILE_OFFSET


@dataclass(frozen=True, slots=True, eq=False)
class Sector:
    """A square of tiles and the k experts whose evidence reaches them.

    Attributes:
        members: cluster number to expert; also keeps the arrays behind `tables` alive.
        corner: (2,) low corner, metres.
        tables: (k, 9) `Member.table` of each expert. scales: (k, 2) `Member.scales`.
        starts: (t * t + 1,) where each tile's entries begin.
        entries: (e, 3) expert, and the first and end of its members near the tile.
    """

    members: Mapping[int, Member]
    corner: NDArray[np.float64]
    tables: NDArray[np.int64]
    scales: NDArray[np.float64]
    starts: NDArray[np.int64]
    entries: NDArray[np.int64]


def build_sector(members: Mapping[int, Member], key: int) -> Sector:
    """The sector with this key, from the experts that reach into it.

    Experts are ordered by cluster number, so that sums do not depend on the order of training.
    """
    ordered = {c: members[c] for c in sorted(members)}
    ix = (key >> TILE_BITS) - TILE_OFFSET
    iy = (key & ((1 << TILE_BITS) - 1)) - TILE_OFFSET
    tables = np.stack([m.table for m in ordered.values()])
    starts, entries = _entries(tables, ix * SECTOR_TILES, iy * SECTOR_TILES)
    return Sector(
        members=ordered,
        corner=np.array([ix * SECTOR_M, iy * SECTOR_M]),
        tables=tables,
        scales=np.stack([m.scales for m in ordered.values()]),
        starts=starts,
        entries=entries,
    )


@intrinsic
def _pointer(typing_context: Any, address: Any) -> Any:
    """An integer address as a pointer that `carray` takes."""

    def generate(context: Any, builder: Any, _signature: Any, args: Any) -> Any:
        return builder.inttoptr(args[0], ir.IntType(8).as_pointer())

    return types.voidptr(types.int64), generate


@compiled
def _local(key: int, x0: int, y0: int) -> int:
    """Number of a tile inside the sector whose first tile is (x0, y0), or -1."""
    x = (key >> TILE_BITS) - TILE_OFFSET - x0
    y = (key & ((1 << TILE_BITS) - 1)) - TILE_OFFSET - y0
    inside = 0 <= x < SECTOR_TILES and 0 <= y < SECTOR_TILES
    return x * SECTOR_TILES + y if inside else -1


@compiled
def _entries(
    tables: NDArray[np.int64], x0: int, y0: int
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """`starts` and `entries` of a `Sector`, by counting first and filling then."""
    starts = np.zeros(SECTOR_TILES * SECTOR_TILES + 1, np.int64)
    for k in range(len(tables)):
        tiles = carray(_pointer(tables[k, TILES]), (tables[k, TILE_COUNT],), np.int64)
        for t in range(len(tiles)):
            local = _local(tiles[t], x0, y0)
            if local >= 0:
                starts[local + 1] += 1
    starts = np.cumsum(starts)
    cursor = starts.copy()
    entries = np.empty((starts[-1], 3), np.int64)
    for k in range(len(tables)):
        count = tables[k, TILE_COUNT]
        tiles = carray(_pointer(tables[k, TILES]), (count,), np.int64)
        first = carray(_pointer(tables[k, STARTS]), (count + 1,), np.int64)
        for t in range(count):
            local = _local(tiles[t], x0, y0)
            if local >= 0:
                e = cursor[local]
                cursor[local] = e + 1
                entries[e, 0] = k
                entries[e, 1] = first[t]
                entries[e, 2] = first[t + 1]
    return starts, entries


@compiled
def _covariance(kind: int, shape: Any, point: Any, inverse: Any) -> float:
    if kind == POINT:
        return point_point(shape, point, inverse)
    if kind == BOX:
        return point_box(shape, point, inverse)
    return point_segment(shape, point, inverse)


@compiled
def committee_sums(
    points: NDArray[np.float64],
    which: NDArray[np.int64],
    corner: NDArray[np.float64],
    tables: NDArray[np.int64],
    scales: NDArray[np.float64],
    starts: NDArray[np.int64],
    entries: NDArray[np.int64],
    fusion: int,
    negligible: float,
    precision: NDArray[np.float64],
    information: NDArray[np.float64],
) -> None:
    """Add the sector's experts to the committee's sums at points[which].

    Args:
        points: (n, 2) metres. which: numbers of the points that lie in this sector.
        corner, tables, scales, starts, entries: of the `Sector`.
        negligible: kernel values below this share of the signal variance count as zero.
        precision, information: (n,) sums to add to.
    """
    room = 0
    for e in range(len(entries)):
        room = max(room, entries[e, 2] - entries[e, 1])
    near, value = np.empty(room, np.int64), np.empty(room)
    inverse = np.empty(2)
    for w in which:
        x, y = points[w, 0], points[w, 1]
        tx = min(max(int((x - corner[0]) / TILE_M), 0), SECTOR_TILES - 1)
        ty = min(max(int((y - corner[1]) / TILE_M), 0), SECTOR_TILES - 1)
        tile = tx * SECTOR_TILES + ty
        for e in range(starts[tile], starts[tile + 1]):
            k = entries[e, 0]
            n, signal = tables[k, SIZE], scales[k, 1]
            inverse[:] = scales[k, 0]
            kinds = carray(_pointer(tables[k, KINDS]), (n,), np.uint8)
            geometry = carray(_pointer(tables[k, GEOMETRY]), (n, 2, 2), np.float64)
            weights = carray(_pointer(tables[k, WEIGHTS]), (n,), np.float64)
            inverse_k = carray(_pointer(tables[k, PRECISION]), (n, n), np.float64)
            members = carray(_pointer(tables[k, MEMBERS]), (entries[e, 2],), np.int32)
            found, mean = 0, 0.0
            for s in range(entries[e, 1], entries[e, 2]):
                i = members[s]
                v = _covariance(kinds[i], geometry[i], points[w], inverse)
                if v > negligible:
                    near[found] = i
                    value[found] = v
                    found += 1
                    mean += v * weights[i]
            if found == 0:
                continue
            explained = 0.0
            for a in range(found):
                row, part = inverse_k[near[a]], 0.0
                for b in range(a):
                    part += value[b] * row[near[b]]
                explained += value[a] * (2.0 * part + value[a] * row[near[a]])
            variance = max(signal * (1.0 - signal * explained), 1e-9 * signal)
            p, i = contribution(fusion, signal * mean, variance, signal)
            precision[w] += p
            information[w] += i
