"""A square of the map with the experts that reach into it, laid out for fast queries.

The arrays of the experts are not copied: the sector keeps their addresses, and the experts alive.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numba import carray
from numpy.typing import NDArray

from gpom_core.committee import SUMS, Fusion
from gpom_core.jit import brief, compiled
from gpom_core.member import (
    AREA,
    BOUNDS,
    COLUMNS,
    CUTOFF_SCALES,
    EXPERTS,
    HOME,
    INVERSE,
    NO_PART,
    OBSERVATIONS,
    REACH,
    SECTOR_M,
    SECTOR_TILES,
    SIZE,
    STARTS,
    TILE_COUNT,
    TILE_M,
    TILES,
    TILES_IN_SECTOR,
    Member,
)
from gpom_core.opinions import tile_sums
from gpom_core.pages import NOT_FILLED, NOTHING, Pages, pages_of
from gpom_core.pointers import pointer
from gpom_core.reach import TILE_BITS, TILE_OFFSET, index_of


@dataclass(frozen=True, slots=True, eq=False)
class Sector:
    """A square of tiles and the k experts whose evidence reaches them.

    Attributes:
        members: cluster number to expert; also keeps the arrays behind `tables` alive.
        numbers: (k,) their cluster numbers, sorted: the order in which experts are added up, so
            that sums do not depend on the order of training.
        corner: (2,) low corner, metres.
        tables: (k, `COLUMNS`) `Member.table` of each expert.
        starts: (t * t + 1,) where each tile's entries begin.
        entries: (e, 3) expert, and the first and end of its members near the tile.
        part: see `member.NO_PART`; of the experts whose first tile is here.
        pages: the field of this sector as far as it was asked for. A cache: entries are replaced.
        used: (t * t,) when each tile of the field was asked for last; written by queries.
        asked: (t * t,) points asked for in each tile since it changed; written by queries.
    """

    members: Mapping[int, Member]
    numbers: NDArray[np.int64]
    corner: NDArray[np.float64]
    tables: NDArray[np.int64]
    starts: NDArray[np.int64]
    entries: NDArray[np.int64]
    part: NDArray[np.float64]
    pages: dict[Fusion, Pages]
    used: NDArray[np.int64]
    asked: NDArray[np.int64]

    def experts_near(self, points: NDArray[np.float64]) -> NDArray[np.int64]:
        """Cluster numbers of those that reach the tiles of points (n, 2) in it."""
        index = np.clip(((points - self.corner) / TILE_M).astype(np.int64), 0, SECTOR_TILES - 1)
        tiles = np.unique(index[:, 0] * SECTOR_TILES + index[:, 1])
        near = [self.entries[self.starts[t] : self.starts[t + 1], 0] for t in tiles.tolist()]
        return self.numbers[np.unique(np.concatenate(near))]


_EMPTY = Sector(
    members={},
    numbers=np.empty(0, np.int64),
    corner=np.zeros(2),
    tables=np.empty((0, COLUMNS), np.int64),
    starts=np.zeros(TILES_IN_SECTOR + 1, np.int64),
    entries=np.empty((0, 3), np.int64),
    part=NO_PART,
    pages={},
    used=np.zeros(TILES_IN_SECTOR, np.int64),
    asked=np.zeros(TILES_IN_SECTOR, np.int64),
)


def changed_sector(
    key: int,
    before: Sector | None,
    changes: Mapping[int, Member | None],
    tiles: NDArray[np.int64],
) -> Sector | None:
    """The sector with this key after some experts were replaced; None if it has no others.

    What it costs goes with the experts that changed, but for a copy of what is kept.

    Args:
        before: its predecessor, if there is one.
        changes: by cluster number the expert as it is now, None if it does not reach the sector.
        tiles: keys of the tiles, in this sector or elsewhere, whose field is not kept.
    """
    new = {c: member for c in sorted(changes) if (member := changes[c]) is not None}
    old = before or _EMPTY
    members = {**old.members, **new}
    for cluster in changes.keys() - new.keys():
        members.pop(cluster, None)
    if not members:
        return None
    ix, iy = index_of(key)
    numbers, tables, starts, entries, marks, part = _replaced(
        old.numbers, old.tables, old.starts, old.entries,
        np.array(sorted(changes), np.int64), np.array(list(new), np.int64),
        np.concatenate([_EMPTY.numbers, *(m.table for m in new.values())]).reshape(-1, COLUMNS),
        ix * SECTOR_TILES, iy * SECTOR_TILES,
    )  # fmt: skip
    gone = _locals(tiles, ix, iy)
    asked = old.asked.copy()
    asked[gone] = 0
    return Sector(
        members=members,
        numbers=numbers,
        corner=np.array([ix * SECTOR_M, iy * SECTOR_M]),
        tables=tables,
        starts=starts,
        entries=entries,
        part=part,
        pages=_pages(marks, old, gone),
        used=old.used.copy(),
        asked=asked,
    )


def _pages(
    marks: NDArray[np.int64], before: Sector, gone: NDArray[np.int64]
) -> dict[Fusion, Pages]:
    """The field's tiles of the sector's predecessor that are still right."""
    empty = Pages(marks, {}, 0)
    pages = {Fusion.BCM: empty, Fusion.RBCM: empty}
    for rule, old in before.pages.items():
        if old.nodes:
            pages[rule] = pages_of(old.without(gone).nodes, marks == NOTHING)
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
def _replaced(
    numbers: NDArray[np.int64],
    tables: NDArray[np.int64],
    starts: NDArray[np.int64],
    entries: NDArray[np.int64],
    changed: NDArray[np.int64],
    new_numbers: NDArray[np.int64],
    new_tables: NDArray[np.int64],
    x0: int,
    y0: int,
) -> tuple[
    NDArray[np.int64], NDArray[np.int64], NDArray[np.int64], NDArray[np.int64],
    NDArray[np.int64], NDArray[np.float64],
]:  # fmt: skip
    """What a `Sector` with first tile (x0, y0) has after some experts are replaced.

    Args:
        numbers, tables, starts, entries: of the sector before.
        changed: (c,) sorted numbers of experts that are no longer what they were.
        new_numbers, new_tables: of those that are here now, sorted.

    Returns:
        numbers, tables, starts, entries, marks of a field that is not filled, part.
    """
    place, new_place, n = _merged(numbers, changed, new_numbers)
    out_numbers, out_tables = np.empty(n, np.int64), np.empty((n, COLUMNS), np.int64)
    for i in range(len(numbers)):
        if place[i] >= 0:
            out_numbers[place[i]], out_tables[place[i]] = numbers[i], tables[i]
    for j in range(len(new_numbers)):
        out_numbers[new_place[j]], out_tables[new_place[j]] = new_numbers[j], new_tables[j]
    first = np.zeros(TILES_IN_SECTOR + 1, np.int64)
    for t in range(TILES_IN_SECTOR):
        for e in range(starts[t], starts[t + 1]):
            first[t + 1] += place[entries[e, 0]] >= 0
    for j in range(len(new_numbers)):
        tiles = carray(pointer(new_tables[j, TILES]), (new_tables[j, TILE_COUNT],), np.int64)
        for t in range(len(tiles)):
            local = _local(tiles[t], x0, y0)
            if local >= 0:
                first[local + 1] += 1
    first = np.cumsum(first)
    out, cursor = np.empty((first[-1], 3), np.int64), first.copy()
    for t in range(TILES_IN_SECTOR):
        for e in range(starts[t], starts[t + 1]):
            k = place[entries[e, 0]]
            if k >= 0:
                at = cursor[t]
                out[at, 0], out[at, 1], out[at, 2] = k, entries[e, 1], entries[e, 2]
                cursor[t] = at + 1
    for j in range(len(new_numbers)):
        k, count = new_place[j], new_tables[j, TILE_COUNT]
        tiles = carray(pointer(new_tables[j, TILES]), (count,), np.int64)
        members = carray(pointer(new_tables[j, STARTS]), (count + 1,), np.int64)
        for t in range(count):
            local = _local(tiles[t], x0, y0)
            if local >= 0:
                at = cursor[local]
                cursor[local] = at + 1
                while at > first[local] and out[at - 1, 0] > k:
                    out[at] = out[at - 1]
                    at -= 1
                out[at, 0], out[at, 1], out[at, 2] = k, members[t], members[t + 1]
    marks = np.full(TILES_IN_SECTOR, NOT_FILLED)
    for t in range(TILES_IN_SECTOR):
        if first[t] == first[t + 1]:
            marks[t] = NOTHING
    return out_numbers, out_tables, first, out, marks, _part(out_tables, x0, y0)


@compiled
def _merged(
    numbers: NDArray[np.int64], changed: NDArray[np.int64], new: NDArray[np.int64]
) -> tuple[NDArray[np.int64], NDArray[np.int64], int]:
    """Where numbers (n,) but for the changed ones, and new ones (m,), go in one sorted array.

    Returns:
        (n,) with -1 for what is changed, (m,), and how many there are then. All sorted.
    """
    place, new_place = np.full(len(numbers), -1), np.empty(len(new), np.int64)
    n, c, j = 0, 0, 0
    for i in range(len(numbers)):
        while j < len(new) and new[j] <= numbers[i]:
            new_place[j] = n
            n, j = n + 1, j + 1
        while c < len(changed) and changed[c] < numbers[i]:
            c += 1
        if c == len(changed) or changed[c] != numbers[i]:
            place[i] = n
            n += 1
    while j < len(new):
        new_place[j] = n
        n, j = n + 1, j + 1
    return place, new_place, n


@compiled
def _part(tables: NDArray[np.int64], x0: int, y0: int) -> NDArray[np.float64]:
    part, numbers = NO_PART.copy(), tables.view(np.float64)
    for k in range(len(tables)):
        if _local(tables[k, HOME], x0, y0) < 0:
            continue
        part[EXPERTS] += 1.0
        part[OBSERVATIONS] += tables[k, SIZE]
        margin = CUTOFF_SCALES / numbers[k, INVERSE]
        for side in range(4):
            bound = numbers[k, BOUNDS + side] if side < 2 else -numbers[k, BOUNDS + side]
            part[AREA + side] = min(part[AREA + side], bound)
            part[REACH + side] = min(part[REACH + side], bound - margin)
    return part


@compiled
def committee_sums(
    points: NDArray[np.float64],
    which: NDArray[np.int64],
    corner: NDArray[np.float64],
    tables: NDArray[np.int64],
    starts: NDArray[np.int64],
    entries: NDArray[np.int64],
    fusion: int,
    negligible: float,
    sums: NDArray[np.float64],
) -> None:
    """Add the sector's experts to the committee's sums at points[which].

    Args:
        points: (n, 2) metres. which: numbers of the points that lie in this sector.
        corner, tables, starts, entries: of the `Sector`.
        negligible: kernel values below this share of the signal variance count as zero.
        sums: (n, 4) to add to; columns as in `gpom_core.committee`.
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
    inside, found = np.empty((most, 2)), np.empty((most, SUMS))
    for t in range(TILES_IN_SECTOR):
        here = order[first[t] : first[t + 1]]
        near = entries[starts[t] : starts[t + 1]]
        if len(here) == 0 or len(near) == 0:
            continue
        for w in range(len(here)):
            inside[w, 0], inside[w, 1] = points[here[w], 0], points[here[w], 1]
        found[: len(here)] = 0.0
        tile_sums(inside[: len(here)], tables, near, fusion, negligible, found[: len(here)])
        for w in range(len(here)):
            for column in range(SUMS):
                sums[here[w], column] += found[w, column]


@brief
def few_sums(
    points: NDArray[np.float64],
    which: NDArray[np.int64],
    corner: NDArray[np.float64],
    tables: NDArray[np.int64],
    starts: NDArray[np.int64],
    entries: NDArray[np.int64],
    fusion: int,
    negligible: float,
    sums: NDArray[np.float64],
) -> None:
    """As `committee_sums`, for so few points that giving up the interpreter does not pay."""
    committee_sums(
        points, which, corner, tables, starts, entries, fusion, negligible, sums
    )  # fmt: skip
