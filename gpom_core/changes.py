"""Which parts of the map differ between two versions, square by square."""

from __future__ import annotations

from gpom_core.member import SECTOR_M
from gpom_core.reach import TILE_BITS, TILE_OFFSET
from gpom_core.snapshot import Snapshot

SQUARE_M = SECTOR_M  # edge of the squares that changes are told in
Square = tuple[int, int]


def squares(snapshot: Snapshot) -> set[Square]:
    """Squares with evidence in reach; square (i, j) begins at (i, j) * SQUARE_M."""
    return {_square(key) for key in snapshot.sectors}


def changed_squares(before: Snapshot, now: Snapshot) -> set[Square]:
    """Squares in which two versions may answer differently; all others answer the same."""
    if before.sectors is now.sectors and _rules(before) == _rules(now):
        return set()
    keys = before.sectors.keys() | now.sectors.keys()
    if _rules(before) != _rules(now):
        return {_square(key) for key in keys}
    # Squares that a swap did not touch are handed on as they are.
    return {_square(key) for key in keys if before.sectors.get(key) is not now.sectors.get(key)}


def _rules(snapshot: Snapshot) -> tuple[object, ...]:
    return snapshot.link, snapshot.prior_variance, snapshot.known_variance_ratio


def _square(key: int) -> Square:
    return (key >> TILE_BITS) - TILE_OFFSET, (key & ((1 << TILE_BITS) - 1)) - TILE_OFFSET
