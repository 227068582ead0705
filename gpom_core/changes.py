"""Which parts of the map differ between two versions, square by square."""

from __future__ import annotations

from gpom_core.member import SECTOR_M
from gpom_core.reach import index_of
from gpom_core.snapshot import Snapshot

SQUARE_M = SECTOR_M  # edge of the squares that changes are told in
Square = tuple[int, int]


def squares(snapshot: Snapshot) -> set[Square]:
    """Squares with evidence in reach; square (i, j) begins at (i, j) * SQUARE_M."""
    return {index_of(key) for key in snapshot.sectors}


def changed_squares(before: Snapshot, now: Snapshot) -> set[Square]:
    """Squares in which two versions may answer differently; all others answer the same."""
    if _rules(before) != _rules(now):
        return squares(before) | squares(now)
    # Squares that a swap did not touch are handed on as they are.
    return {index_of(key) for key in now.sectors.changed_since(before.sectors)}


def _rules(snapshot: Snapshot) -> tuple[object, ...]:
    return snapshot.link, snapshot.prior_variance, snapshot.known_variance_ratio
