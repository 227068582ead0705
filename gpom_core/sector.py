"""A square of the map with the experts that reach into it, laid out for fast queries.

The arrays of the experts are not copied: the sector keeps their addresses, and the experts alive.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from llvmlite import ir
from numba import carray, types
from numba.extending import intrinsic
from numpy.typing import NDArray

from gpom_core.beams import BOX, POINT
from gpom_core.committee import contribution
from gpom_core.jit import compiled
from gpom_core.kernels import point_box, point_point, point_segment
from gpom_core.reach import TILE_BITS, TILE_OFFSET

if TYPE_CHECKING:
    from gpom_core.snapshot import Member

KINDS, GEOMETRY, WEIGHTS, PRECISION, MEMBERS = range(5)  # columns of `addresses`


@dataclass(frozen=True, slots=True, eq=False)
class Sector:
    """t x t tiles and the k experts whose evidence reaches them.

    Attributes:
        members: cluster number to expert; also keeps the arrays behind `addresses` alive.
        addresses: (k, 5) int64 of kinds, geometry, weights, precision and the reach's members.
        sizes: (k,) observations of each expert.
        scales: (k, 2) inverse length scale and signal variance.
        starts: (t * t + 1,) where each tile's entries begin.
        entries: (e, 3) expert, and the first and end of its members near the tile.
    """

    members: Mapping[int, Member]
    addresses: NDArray[np.int64]
    sizes: NDArray[np.int64]
    scales: NDArray[np.float64]
    starts: NDArray[np.int64]
    entries: NDArray[np.int64]


def build_sector(members: Mapping[int, Member], ix: int, iy: int, tiles: int) -> Sector:
    """Sector (ix, iy) of `tiles` x `tiles` tiles, from the experts that reach into it.

    Experts are ordered by cluster number, so that sums do not depend on the order of training.
    """
    ordered = {c: members[c] for c in sorted(members)}
    counts = np.zeros(tiles * tiles + 1, np.int64)
    for member in ordered.values():
        _count_entries(member.reach.tiles, ix, iy, tiles, counts)
    starts = np.cumsum(counts)
    entries = np.empty((int(starts[-1]), 3), np.int64)
    cursor = starts[:-1].copy()
    for k, member in enumerate(ordered.values()):
        _fill_entries(member.reach.tiles, member.reach.starts, k, ix, iy, tiles, cursor, entries)
    return Sector(
        members=ordered,
        addresses=np.array([m.addresses for m in ordered.values()], np.int64).reshape(-1, 5),
        sizes=np.array([len(m.expert.observations) for m in ordered.values()], np.int64),
        scales=np.array([m.scales for m in ordered.values()]).reshape(-1, 2),
        starts=starts,
        entries=entries,
    )


@compiled
def _local(key: int, ix: int, iy: int, tiles: int) -> int:
    """Number of a tile inside sector (ix, iy), or -1."""
    x = (key >> TILE_BITS) - TILE_OFFSET - ix * tiles
    y = (key & ((1 << TILE_BITS) - 1)) - TILE_OFFSET - iy * tiles
    return x * tiles + y if 0 <= x < tiles and 0 <= y < tiles else -1


@compiled
def _count_entries(keys: Any, ix: int, iy: int, tiles: int, counts: Any) -> None:
    for t in range(len(keys)):
        local = _local(keys[t], ix, iy, tiles)
        if local >= 0:
            counts[local + 1] += 1


@compiled
def _fill_entries(
    keys: Any, starts: Any, k: int, ix: int, iy: int, tiles: int, cursor: Any, entries: Any
) -> None:
    for t in range(len(keys)):
        local = _local(keys[t], ix, iy, tiles)
        if local >= 0:
            entries[cursor[local], 0] = k
            entries[cursor[local], 1] = starts[t]
            entries[cursor[local], 2] = starts[t + 1]
            cursor[local] += 1


@intrinsic
def _pointer(typing_context: Any, address: Any) -> Any:
    """An integer address as a pointer that `carray` takes."""

    def generate(context: Any, builder: Any, _signature: Any, args: Any) -> Any:
        return builder.inttoptr(args[0], ir.IntType(8).as_pointer())

    return types.voidptr(types.int64), generate


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
    tile_m: float,
    tiles: int,
    addresses: NDArray[np.int64],
    sizes: NDArray[np.int64],
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
        corner: (2,) low corner of the sector.
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
        tx = min(max(int((x - corner[0]) / tile_m), 0), tiles - 1)
        ty = min(max(int((y - corner[1]) / tile_m), 0), tiles - 1)
        tile = tx * tiles + ty
        for e in range(starts[tile], starts[tile + 1]):
            k = entries[e, 0]
            n, signal = sizes[k], scales[k, 1]
            inverse[:] = scales[k, 0]
            kinds = carray(_pointer(addresses[k, KINDS]), (n,), np.uint8)
            geometry = carray(_pointer(addresses[k, GEOMETRY]), (n, 2, 2), np.float64)
            weights = carray(_pointer(addresses[k, WEIGHTS]), (n,), np.float64)
            inverse_k = carray(_pointer(addresses[k, PRECISION]), (n, n), np.float64)
            members = carray(_pointer(addresses[k, MEMBERS]), (entries[e, 2],), np.int32)
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
