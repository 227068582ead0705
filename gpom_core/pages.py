"""The filled tiles of one sector's field: immutable, replaced as a whole."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from gpom_core.jit import vectorised

Nodes = NDArray[np.float32]

INTERVAL_BITS: Final = 7  # enough for 64 intervals; addresses of today's machines have 47 bits
NOT_FILLED: Final = 0  # in place of a tile's mark
NOTHING: Final = -1  # no expert reaches the tile


@dataclass(frozen=True, slots=True, eq=False)
class Pages:
    """Nodes of the tiles of a sector that were filled, by the tile's number in it.

    Attributes:
        marks: (tiles,) `mark` of the nodes, or `NOT_FILLED` or `NOTHING`.
        nodes: keeps what the marks lead to alive.
        size_bytes: of all nodes.
    """

    marks: NDArray[np.int64]
    nodes: Mapping[int, Nodes]
    size_bytes: int

    def has(self, tile: int) -> bool:
        """Whether there is nothing to fill in a tile."""
        return bool(self.marks[tile] != NOT_FILLED)

    def with_tiles(self, filled: Mapping[int, Nodes]) -> Pages:
        """These pages and more."""
        return pages_of({**self.nodes, **filled}, self.marks == NOTHING)

    def without(self, tiles: NDArray[np.int64]) -> Pages:
        """These pages but for some."""
        gone = set(tiles.tolist())
        kept = {t: n for t, n in self.nodes.items() if t not in gone}
        return pages_of(kept, self.marks == NOTHING)


def pages_of(nodes: Mapping[int, Nodes], nothing: NDArray[np.bool_]) -> Pages:
    """Pages of tiles filled with nodes (n + 1, n + 1, 4).

    Args:
        nothing: (tiles,) where no expert reaches.
    """
    marks = np.where(nothing, NOTHING, NOT_FILLED)
    for tile, values in nodes.items():
        marks[tile] = mark(values.ctypes.data, len(values) - 1)
    return Pages(marks, dict(nodes), sum(v.nbytes for v in nodes.values()))


@vectorised
def mark(address: int, intervals: int) -> int:
    """One number for where nodes are and how many intervals they span: one look-up, not two."""
    return (address << INTERVAL_BITS) | intervals
