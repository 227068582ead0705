"""A trained expert as a member of the committee: its index of evidence, and where it reaches."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from gpom_core.expert import Expert
from gpom_core.reach import TILE_BITS, TILE_OFFSET, Reach
from gpom_core.sides import Sides, sides_of

Bounds = tuple[float, float, float, float]

TILE_M = 0.5  # of the index; smaller tiles cost memory, larger ones time (see ARCHITECTURE)
SECTOR_SHIFT = 4
SECTOR_TILES = 1 << SECTOR_SHIFT
SECTOR_M = TILE_M * SECTOR_TILES
TILES_IN_SECTOR = SECTOR_TILES * SECTOR_TILES

# Columns of `Member.table`: addresses of arrays, then their lengths.
(
    KINDS, GEOMETRY, WEIGHTS, PRECISION, EDGES, CORNERS, FACTORS, MEMBERS, TILES, STARTS,
    SIZE, TILE_COUNT,
) = range(12)  # fmt: skip


@dataclass(frozen=True, slots=True, eq=False)
class Member:
    """An expert in the committee.

    Attributes:
        line: (2, 2) ends of the cluster's line, metres.
        bounds: of the evidence. revision: of the evidence that it was trained on.
        table: (12,) addresses of the arrays that queries read, and their lengths.
        scales: (2,) inverse length scale, 1/m, and signal variance.
        sectors: keys of the sectors that the evidence reaches.
    """

    cluster_id: int
    revision: int
    expert: Expert
    reach: Reach
    line: NDArray[np.float64]
    bounds: Bounds
    sides: Sides = field(init=False, repr=False)
    table: NDArray[np.int64] = field(init=False, repr=False)
    scales: NDArray[np.float64] = field(init=False, repr=False)
    sectors: frozenset[int] = field(init=False, repr=False)

    def __post_init__(self) -> None:
        o, r, h = self.expert.observations, self.reach, self.expert.hyperparameters
        arrays = (o.kinds, o.geometry, self.expert.weights, self.expert.precision)
        if not all(array.flags.c_contiguous for array in arrays):
            raise ValueError("an expert's arrays must be contiguous: queries read them by address")
        sides = sides_of(o.kinds, o.geometry, h.length_scale_m)
        addresses = [a.ctypes.data for a in (*arrays, *sides, r.members, r.tiles, r.starts)]
        table = np.array([*addresses, len(o), len(r.tiles)], np.int64)
        x = ((r.tiles >> TILE_BITS) - TILE_OFFSET) >> SECTOR_SHIFT
        y = ((r.tiles & ((1 << TILE_BITS) - 1)) - TILE_OFFSET) >> SECTOR_SHIFT
        object.__setattr__(self, "sides", sides)
        object.__setattr__(self, "table", table)
        object.__setattr__(self, "scales", np.array([1.0 / h.length_scale_m, h.signal_std**2]))
        object.__setattr__(self, "sectors", frozenset(np.unique(sector_key(x, y)).tolist()))

    @property
    def size_bytes(self) -> int:
        """Memory of all that queries read."""
        o, e = self.expert.observations, self.expert
        arrays = (o.kinds, o.geometry, e.weights, e.precision, *self.sides, *self.reach)
        return sum(array.nbytes for array in arrays)

    def __reduce__(self) -> tuple[type[Member], tuple[object, ...]]:
        # Addresses do not survive a journey to another process.
        return type(self), (
            self.cluster_id, self.revision, self.expert, self.reach, self.line, self.bounds,
        )  # fmt: skip


def sector_key(x: NDArray[np.int64], y: NDArray[np.int64]) -> NDArray[np.int64]:
    """Keys (n,) of the sectors with indices x and y."""
    return ((x + TILE_OFFSET) << TILE_BITS) | (y + TILE_OFFSET)
