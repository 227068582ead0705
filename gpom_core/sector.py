"""A square of the map with the experts that reach into it, laid out for fast queries.

The arrays of the experts are not copied: the sector keeps their addresses, and the experts alive.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TypeVar

import numpy as np
from numba import carray
from numpy.typing import NDArray

from gpom_core.committee import Fusion
from gpom_core.jit import brief, compiled
from gpom_core.member import (
    SECTOR_M,
    SECTOR_TILES,
    STARTS,
    TILE_COUNT,
    TILE_M,
    TILES,
    TILES_IN_SECTOR,
    Member,
)
from gpom_core.opinions import tile_sums
from gpom_core.pages import Pages, pages_of
from gpom_core.pointers import pointer
from gpom_core.reach import TILE_BITS, TILE_OFFSET

_T = TypeVar("_T", bound=np.generic)


@dataclass(frozen=True, slots=True, eq=False)
class Sector:
    """A square of tiles and the k experts whose evidence reaches them.

    Attributes:
        members: cluster number to expert; also keeps the arrays behind `tables` alive.
        corner: (2,) low corner, metres.
        tables: (k, 9) `Member.table` of each expert. scales: (k, 2) `Member.scales`.
        starts: (t * t + 1,) where each tile's entries begin.
        entries: (e, 3) expert, and the first and end of its members near the tile.
        pages: the field of this sector as far as it was asked for. A cache: entries are replaced.
        used: (t * t,) when each tile of the field was asked for last; written by queries.
        asked: (t * t,) points asked for in each tile since it changed; written by queries.
    """

    members: Mapping[int, Member]
    corner: NDArray[np.float64]
    tables: NDArray[np.int64]
    scales: NDArray[np.float64]
    starts: NDArray[np.int64]
    entries: NDArray[np.int64]
    pages: dict[Fusion, Pages]
    used: NDArray[np.int64]
    asked: NDArray[np.int64]

    def experts_near(self, points: NDArray[np.float64]) -> NDArray[np.int64]:
        """Numbers, in the order of `members`, of those that reach the tiles of points in it."""
        index = np.clip(((points - self.corner) / TILE_M).astype(np.int64), 0, SECTOR_TILES - 1)
        tiles = np.unique(index[:, 0] * SECTOR_TILES + index[:, 1])
        near = [self.entries[self.starts[t] : self.starts[t + 1], 0] for t in tiles.tolist()]
        return np.unique(np.concatenate(near))


def build_sector(
    members: Mapping[int, Member],
    key: int,
    before: Sector | None = None,
    changed: NDArray[np.int64] | None = None,
) -> Sector:
    """The sector with this key, from the experts that reach into it.

    Experts are ordered by cluster number, so that sums do not depend on the order of training.

    Args:
        before: its predecessor, whose field is kept.
        changed: keys of tiles, in this sector or elsewhere, whose field is not kept.
    """
    ordered = {c: members[c] for c in sorted(members)}
    ix = (key >> TILE_BITS) - TILE_OFFSET
    iy = (key & ((1 << TILE_BITS) - 1)) - TILE_OFFSET
    tables = _rows([m.table for m in ordered.values()])
    starts, entries = _entries(tables, ix * SECTOR_TILES, iy * SECTOR_TILES)
    gone = _locals(np.empty(0, np.int64) if changed is None else changed, ix, iy)
    return Sector(
        members=ordered,
        corner=np.array([ix * SECTOR_M, iy * SECTOR_M]),
        tables=tables,
        scales=_rows([m.scales for m in ordered.values()]),
        starts=starts,
        entries=entries,
        pages=_pages(starts, before, gone),
        used=np.zeros(TILES_IN_SECTOR, np.int64) if before is None else before.used.copy(),
        asked=_asked(before, gone),
    )


def _rows(arrays: list[NDArray[_T]]) -> NDArray[_T]:
    """As `np.stack`, which wraps every array: a third of a swap."""
    return np.concatenate(arrays).reshape(len(arrays), -1)


def _asked(before: Sector | None, gone: NDArray[np.int64]) -> NDArray[np.int64]:
    asked = np.zeros(TILES_IN_SECTOR, np.int64) if before is None else before.asked.copy()
    asked[gone] = 0
    return asked


def _pages(
    starts: NDArray[np.int64], before: Sector | None, gone: NDArray[np.int64]
) -> dict[Fusion, Pages]:
    """The field's tiles of the sector's predecessor that are still right."""
    nothing = starts[1:] == starts[:-1]
    pages = {rule: pages_of({}, nothing) for rule in (Fusion.BCM, Fusion.RBCM)}
    if before is not None:
        for rule, old in before.pages.items():
            if old.nodes:
                pages[rule] = pages_of(old.without(gone).nodes, nothing)
    return pages


@compiled
def _local(key: int, x0: int, y0: int) -> int:
    """Number of a tile inside the sector whose first tile is (x0, y0), or -1."""
    x = (key >> TILE_BITS) - TILE_OFFSET - x0
    y = (key & ((1 << TILE_BITS) - 1)) - TILE_OFFSET - y0
    inside = 0 <= x < SECTOR_TILES and 0 <= y < SECTOR_TILES
    return x * SECTOR_TILES + y if inside else -1


@compiled
def _locals(keys: NDArray[np.int64], ix: int, iy: int) -> NDArray[np.int64]:
    """Numbers within sector (ix, iy) of those tiles that are in it."""
    out = np.empty(len(keys), np.int64)
    found = 0
    for i in range(len(keys)):
        local = _local(keys[i], ix * SECTOR_TILES, iy * SECTOR_TILES)
        if local >= 0:
            out[found] = local
            found += 1
    return out[:found]


@compiled
def _entries(
    tables: NDArray[np.int64], x0: int, y0: int
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """`starts` and `entries` of a `Sector`, by counting first and filling then."""
    starts = np.zeros(TILES_IN_SECTOR + 1, np.int64)
    for k in range(len(tables)):
        tiles = carray(pointer(tables[k, TILES]), (tables[k, TILE_COUNT],), np.int64)
        for t in range(len(tiles)):
            local = _local(tiles[t], x0, y0)
            if local >= 0:
                starts[local + 1] += 1
    starts = np.cumsum(starts)
    cursor = starts.copy()
    entries = np.empty((starts[-1], 3), np.int64)
    for k in range(len(tables)):
        count = tables[k, TILE_COUNT]
        tiles = carray(pointer(tables[k, TILES]), (count,), np.int64)
        first = carray(pointer(tables[k, STARTS]), (count + 1,), np.int64)
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
    tile = np.empty(len(which), np.int64)
    first = np.zeros(TILES_IN_SECTOR + 1, np.int64)
    most = 0
    for w in range(len(which)):
        x, y = points[which[w], 0] - corner[0], points[which[w], 1] - corner[1]
        tx = min(max(int(x / TILE_M), 0), SECTOR_TILES - 1)
        ty = min(max(int(y / TILE_M), 0), SECTOR_TILES - 1)
        tile[w] = tx * SECTOR_TILES + ty
        first[tile[w] + 1] += 1
        most = max(most, first[tile[w] + 1])
    first = np.cumsum(first)
    cursor = first.copy()
    order = np.empty(len(which), np.int64)
    for w in range(len(which)):
        order[cursor[tile[w]]] = which[w]
        cursor[tile[w]] += 1
    inside, sums = np.empty((most, 2)), np.empty((2, most))
    for t in range(TILES_IN_SECTOR):
        here = order[first[t] : first[t + 1]]
        near = entries[starts[t] : starts[t + 1]]
        if len(here) == 0 or len(near) == 0:
            continue
        for w in range(len(here)):
            inside[w, 0], inside[w, 1] = points[here[w], 0], points[here[w], 1]
        sums[:, : len(here)] = 0.0
        tile_sums(inside[: len(here)], tables, scales, near, fusion, negligible, sums[0], sums[1])
        for w in range(len(here)):
            precision[here[w]] += sums[0, w]
            information[here[w]] += sums[1, w]


@brief
def few_sums(
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
    """As `committee_sums`, for so few points that giving up the interpreter does not pay."""
    committee_sums(
        points, which, corner, tables, scales, starts, entries, fusion, negligible,
        precision, information,
    )  # fmt: skip
