"""A trained expert as a member of the committee: its index of evidence, and where it reaches."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from gpom_core.expert import Expert
from gpom_core.jit import compiled
from gpom_core.reach import TILE_BITS, TILE_OFFSET, index_of, reach_of, tile_key
from gpom_core.sides import sides_of

Bounds = tuple[float, float, float, float]

TILE_M = 0.5  # of the index; smaller tiles cost memory, larger ones time (see ARCHITECTURE)
SECTOR_SHIFT = 4
SECTOR_TILES = 1 << SECTOR_SHIFT
SECTOR_M = TILE_M * SECTOR_TILES
TILES_IN_SECTOR = SECTOR_TILES * SECTOR_TILES

# Columns of `Member.table`: addresses of arrays, then their lengths, then the first tile. From
# `INVERSE` on they hold float64: one over the length scale, 1/m, the signal's variance, the bounds.
(
    KINDS, GEOMETRY, WEIGHTS, PRECISION, EDGES, CORNERS, FACTORS, MEMBERS, TILES, STARTS,
    SIZE, TILE_COUNT, SECTOR_COUNT, HOME, INVERSE, SIGNAL, BOUNDS,
) = range(17)  # fmt: skip
COLUMNS = BOUNDS + 4

# What some experts cover together, (10,): how many, their observations, the bounds of their
# evidence, and these grown by how far it has a say. High bounds with their sign turned, so that of
# several parts the smallest counts.
EXPERTS, OBSERVATIONS, AREA, REACH, _PART = 0, 1, 2, 6, 10
NO_PART = np.repeat([0.0, np.inf], [AREA, _PART - AREA])


# Evidence farther away, in length scales, has no say. The inverse matrices' large entries make
# distant values count: on a real log this moves no probability by 4e-4, while 4 moved some by 8e-3.
CUTOFF_SCALES = 4.75


@dataclass(frozen=True, slots=True, eq=False)
class Member:
    """An expert in the committee.

    Attributes:
        revision: of the evidence that it was trained on.
        line: (2, 2) ends of the cluster's line, metres.
        block: the memory behind all that follows and is an array.
        bounds: of the evidence.
        table: (`COLUMNS`,) addresses of the arrays that queries read, and their lengths: those of
            the expert, of `Sides` and of `Reach`; and more, see there.
        tiles: (t,) keys of the tiles that the evidence reaches.
        sectors: keys of the sectors that they are in.
    """

    cluster_id: int
    revision: int
    expert: Expert
    line: NDArray[np.float64]
    block: NDArray[np.int64] = field(init=False, repr=False)
    bounds: Bounds = field(init=False)
    table: NDArray[np.int64] = field(init=False, repr=False)
    tiles: NDArray[np.int64] = field(init=False, repr=False)
    sectors: frozenset[int] = field(init=False, repr=False)

    def __post_init__(self) -> None:
        o, h = self.expert.observations, self.expert.hyperparameters
        arrays = (o.kinds, o.geometry, self.expert.weights, self.expert.precision)
        for array in arrays:
            if not array.flags.c_contiguous:
                raise ValueError("an expert's arrays are read by address: they must be contiguous")
        # One block of memory, not nine arrays: these would take longer to make than their content.
        block = _index(*arrays, h.length_scale_m, h.signal_std)
        table, numbers = block[:COLUMNS], block[BOUNDS:COLUMNS].view(np.float64)
        tiles, sectors = int(table[TILE_COUNT]), int(table[SECTOR_COUNT])
        write = object.__setattr__
        write(self, "block", block)
        write(self, "bounds", tuple(numbers.tolist()))
        write(self, "table", table)
        write(self, "tiles", block[COLUMNS : COLUMNS + tiles])
        write(self, "sectors", frozenset(block[len(block) - sectors :].tolist()))

    @property
    def reach(self) -> Bounds:
        """As `bounds`, grown by how far evidence has a say."""
        margin = CUTOFF_SCALES * self.expert.hyperparameters.length_scale_m
        xmin, ymin, xmax, ymax = self.bounds
        return xmin - margin, ymin - margin, xmax + margin, ymax + margin

    @property
    def size_bytes(self) -> int:
        """Memory of all that queries read."""
        o, e = self.expert.observations, self.expert
        arrays = (o.kinds, o.geometry, e.weights, e.precision, self.block)
        return sum(array.nbytes for array in arrays)

    def __reduce__(self) -> tuple[type[Member], tuple[object, ...]]:
        # Addresses do not survive a journey to another process.
        return type(self), (self.cluster_id, self.revision, self.expert, self.line)


@compiled
def _index(
    kinds: NDArray[np.uint8],
    geometry: NDArray[np.float64],
    weights: NDArray[np.float64],
    precision: NDArray[np.float64],
    length_scale_m: float,
    signal_std: float,
) -> NDArray[np.int64]:
    """The block of a `Member`: its table, the tiles, what else that leads to, the sectors."""
    n = len(kinds)
    reach = reach_of(geometry, TILE_M, CUTOFF_SCALES * length_scale_m)
    sides = sides_of(kinds, geometry, length_scale_m)
    sectors = _sectors_of(reach.tiles)
    tiles, members, edges = len(reach.tiles), len(reach.members), len(sides.edges)
    words = (members + 1) // 2  # of 64 bits; corners take two for an observation
    block = np.empty(COLUMNS + 2 * tiles + 1 + words + edges + 3 * n + len(sectors), np.int64)
    numbers, halves = block.view(np.float64), block.view(np.int32)
    at = COLUMNS
    block[TILES] = at
    block[at : at + tiles] = reach.tiles
    at += tiles
    block[STARTS] = at
    block[at : at + tiles + 1] = reach.starts
    at += tiles + 1
    block[MEMBERS] = at
    halves[2 * at : 2 * at + members] = reach.members
    at += words
    block[EDGES] = at
    numbers[at : at + edges] = sides.edges
    at += edges
    block[CORNERS] = at
    halves[2 * at : 2 * at + 4 * n] = sides.corners.reshape(-1)
    at += 2 * n
    block[FACTORS] = at
    numbers[at : at + n] = sides.factor
    at += n
    block[at:] = sectors
    for column in (TILES, STARTS, MEMBERS, EDGES, CORNERS, FACTORS):
        block[column] = block.ctypes.data + 8 * block[column]
    block[KINDS], block[GEOMETRY] = kinds.ctypes.data, geometry.ctypes.data
    block[WEIGHTS], block[PRECISION] = weights.ctypes.data, precision.ctypes.data
    block[SIZE], block[TILE_COUNT], block[SECTOR_COUNT] = n, tiles, len(sectors)
    block[HOME] = reach.tiles[0] if tiles > 0 else 0
    numbers[INVERSE], numbers[SIGNAL] = 1.0 / length_scale_m, signal_std * signal_std
    for axis in range(2):
        low, high = np.inf, -np.inf
        for i in range(n):
            for end in range(2):
                low = min(low, geometry[i, end, axis])
                high = max(high, geometry[i, end, axis])
        numbers[BOUNDS + axis], numbers[BOUNDS + 2 + axis] = low, high
    return block


@compiled
def _sectors_of(tiles: NDArray[np.int64]) -> NDArray[np.int64]:
    """Keys of the sectors that hold some tiles; a sector may come up more than once."""
    found = np.empty(len(tiles), np.int64)
    n = 0
    for t in range(len(tiles)):
        key = tile_key(
            ((tiles[t] >> TILE_BITS) - TILE_OFFSET) >> SECTOR_SHIFT,
            ((tiles[t] & ((1 << TILE_BITS) - 1)) - TILE_OFFSET) >> SECTOR_SHIFT,
        )
        if n == 0 or found[n - 1] != key:
            found[n] = key
            n += 1
    return found[:n].copy()


def sector_key(x: NDArray[np.int64], y: NDArray[np.int64]) -> NDArray[np.int64]:
    """Keys (n,) of the sectors with indices x and y."""
    return ((x + TILE_OFFSET) << TILE_BITS) | (y + TILE_OFFSET)


def sector_area(key: int) -> Bounds:
    """xmin, ymin, xmax, ymax of the sector with this key, metres."""
    x, y = index_of(key)
    return x * SECTOR_M, y * SECTOR_M, (x + 1) * SECTOR_M, (y + 1) * SECTOR_M
