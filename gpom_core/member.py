"""A trained expert as a member of the committee: its index of evidence, and where it reaches."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from threading import local
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from gpom_core.expert import (
    Expert,
    Hyperparameters,
    condition,
    noisy,
    refuse_empty,
    refuse_indefinite,
)
from gpom_core.inverse import LARGEST_SWEPT, addresses_for, padded
from gpom_core.jit import compiled, vectorised
from gpom_core.kernels import gram_upper_into
from gpom_core.observations import Observations
from gpom_core.reach import TILE_BITS, TILE_OFFSET, index_of, reach_of, tile_key
from gpom_core.rows import BOX, SEGMENT
from gpom_core.shapes import refuse
from gpom_core.sides import sides_of

Bounds = tuple[float, float, float, float]
_Index = TypeVar("_Index", int, NDArray[np.int64])

TILE_M = 0.5  # of the index; smaller tiles cost memory, larger ones time (see ARCHITECTURE)
SECTOR_SHIFT = 4
SECTOR_TILES = 1 << SECTOR_SHIFT
SECTOR_M = TILE_M * SECTOR_TILES
TILES_IN_SECTOR = SECTOR_TILES * SECTOR_TILES

# Columns of `Member.table`: addresses of arrays, then their lengths, then the first tile. From
# `INVERSE` on they hold float64: one over the length scale, 1/m, the signal's variance, the bounds.
(
    KINDS, GEOMETRY, WEIGHTS, PRECISION, EDGES, CORNERS, FACTORS, COUNTS, MEMBERS, TILES, STARTS,
    SIZE, TILE_COUNT, SECTOR_COUNT, HOME, INVERSE, SIGNAL, BOUNDS,
) = range(18)  # fmt: skip
COLUMNS = BOUNDS + 4

# What some experts cover together, (10,): how many, their observations, the bounds of their
# evidence, and these grown by how far it has a say. High bounds with their sign turned, so that of
# several parts the smallest counts.
EXPERTS, OBSERVATIONS, AREA, REACH, _PART = 0, 1, 2, 6, 10
NO_PART = np.repeat([0.0, np.inf], [AREA, _PART - AREA])


# Evidence farther away, in length scales, has no say. The inverse matrices' large entries make
# distant values count: on a real log this moves no probability by 4e-4, while 4 moved some by 8e-3.
CUTOFF_SCALES = 4.75
_LINE_SHARE = 0.3989422804014327  # 1 / sqrt(2 pi)
_LEAST_NOISE = 1e-12  # share of the signal's variance


@dataclass(frozen=True, slots=True, eq=False)
class Member:
    """An expert in the committee; made by `train_member` or `member_of`.

    Attributes:
        revision: of the evidence that it was trained on.
        line: (2, 2) ends of the cluster's line, metres.
        block: the memory behind all that queries read but the observations: one array, for many
            small ones would take longer to make than their content.
    """

    cluster_id: int
    revision: int
    expert: Expert
    line: NDArray[np.float64]
    block: NDArray[np.int64] = field(repr=False)

    @property
    def table(self) -> NDArray[np.int64]:
        """Addresses of the arrays that queries read, their lengths and more, (`COLUMNS`,)."""
        return self.block[:COLUMNS]

    @property
    def tiles(self) -> NDArray[np.int64]:
        """Keys of the tiles that the evidence reaches, (t,)."""
        return self.block[COLUMNS : COLUMNS + int(self.block[TILE_COUNT])]

    @property
    def sectors(self) -> list[int]:
        """Keys of the sectors that they are in; one may come up more than once."""
        end = _weights_at(self.block)
        keys: list[int] = self.block[end - int(self.block[SECTOR_COUNT]) : end].tolist()
        return keys

    @property
    def bounds(self) -> Bounds:
        """Of the evidence."""
        xmin, ymin, xmax, ymax = self.block[BOUNDS:COLUMNS].view(np.float64).tolist()
        return xmin, ymin, xmax, ymax

    @property
    def reach(self) -> Bounds:
        """As `bounds`, grown by how far evidence has a say."""
        margin = CUTOFF_SCALES * self.expert.hyperparameters.length_scale_m
        xmin, ymin, xmax, ymax = self.bounds
        return xmin - margin, ymin - margin, xmax + margin, ymax + margin

    @property
    def size_bytes(self) -> int:
        """Memory of all that queries read."""
        o = self.expert.observations
        return o.kinds.nbytes + o.geometry.nbytes + self.block.nbytes

    def __reduce__(self) -> tuple[Callable[..., Member], tuple[object, ...]]:
        # Addresses do not survive a journey to another process.
        return member_of, (self.cluster_id, self.revision, self.expert, self.line)


def train_member(
    cluster_id: int,
    revision: int,
    observations: Observations,
    hyperparameters: Hyperparameters,
    line: NDArray[np.float64],
    *,
    has_its_noise: bool = False,
) -> Member:
    """Train an expert for the committee: `expert.train` and its index in one compiled call.

    Args:
        has_its_noise: that of the observations needs no factor of the hyperparameters any more.

    Raises:
        TrainingError: there are no observations, or the covariance is not positive definite.
        ValueError: the observations are no shapes, or not in the plane.
    """
    refuse_empty(observations)
    _refuse_unreadable(observations)
    if not has_its_noise:
        observations = noisy(observations, hyperparameters)
    o = observations
    block, log_likelihood, fault = _trained(
        o.kinds, o.geometry, o.targets, o.noise_variance,
        hyperparameters.length_scale_m, hyperparameters.signal_std,
        addresses_for(len(o)), _thread.scratch,
    )  # fmt: skip
    refuse(fault)
    refuse_indefinite(o, log_likelihood)
    weights, packed = _inside(block)
    expert = Expert(o, hyperparameters, weights, packed, log_likelihood)
    return Member(cluster_id, revision, expert, line, block)


def member_of(cluster_id: int, revision: int, expert: Expert, line: NDArray[np.float64]) -> Member:
    """A trained expert with its index; its weights and precision are copied beside it."""
    o, h = expert.observations, expert.hyperparameters
    _refuse_unreadable(o)
    block = _index(o.kinds, o.geometry, o.noise_variance, h.length_scale_m, h.signal_std)
    weights, packed = _inside(block)
    weights[:], packed[:] = expert.weights, expert.packed
    inside = replace(expert, weights=weights, packed=packed)
    return Member(cluster_id, revision, inside, line, block)


def _refuse_unreadable(observations: Observations) -> None:
    """Queries read these arrays by their addresses, and look at nothing else."""
    kinds, geometry = observations.kinds, observations.geometry
    if geometry.shape[2] != 2 or geometry.dtype != np.float64 or kinds.dtype != np.uint8:
        raise ValueError(
            f"geometry is {geometry.dtype} {geometry.shape} and kinds are {kinds.dtype}; members "
            "of a committee have float64 (n, 2, 2) and uint8"
        )
    if not (geometry.flags.c_contiguous and kinds.flags.c_contiguous):
        raise ValueError("an expert's arrays are read by address: they must be contiguous")


class _Thread(local):
    """What each thread has of its own: room for the largest matrix that is swept."""

    def __init__(self) -> None:
        self.scratch = np.empty(LARGEST_SWEPT**2)  # memory only as far as it is used


_thread = _Thread()


def _weights_at(block: NDArray[np.int64]) -> int:
    n = int(block[SIZE])
    return len(block) - n - n * (n + 1) // 2


def _inside(block: NDArray[np.int64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """The weights and the packed precision in a block."""
    numbers, at = block.view(np.float64), _weights_at(block)
    end = at + int(block[SIZE])
    return numbers[at:end], numbers[end:]


@compiled
def _trained(
    kinds: NDArray[np.uint8],
    geometry: NDArray[np.float64],
    targets: NDArray[np.float64],
    noise_variance: NDArray[np.float64],
    length_scale_m: float,
    signal_std: float,
    addresses: NDArray[np.int64],
    scratch: NDArray[np.float64],
) -> tuple[NDArray[np.int64], float, int]:
    """Train an expert; its block, log likelihood, and the fault of its shapes."""
    n = len(kinds)
    edge = padded(n)
    room = scratch if n <= LARGEST_SWEPT else np.empty(edge * edge)
    a = room[: edge * edge].reshape(edge, edge)
    inverse = np.full(geometry.shape[2], 1.0 / length_scale_m)
    fault = gram_upper_into(kinds, geometry, inverse, a)
    if fault != 0:
        return np.empty(0, np.int64), 0.0, fault
    block = _index(kinds, geometry, noise_variance, length_scale_m, signal_std)
    end = len(block) - n * (n + 1) // 2
    numbers = block.view(np.float64)
    log_likelihood = condition(
        a, targets, noise_variance, signal_std * signal_std, addresses,
        numbers[end - n : end], numbers[end:],
    )  # fmt: skip
    return block, log_likelihood, 0


@compiled
def _index(
    kinds: NDArray[np.uint8],
    geometry: NDArray[np.float64],
    noise_variance: NDArray[np.float64],
    length_scale_m: float,
    signal_std: float,
) -> NDArray[np.int64]:
    """The block of a `Member`, with room for the weights and the packed precision.

    In this order: its table, the tiles, what else that leads to, the sectors, and those two.
    """
    n = len(kinds)
    reach = reach_of(geometry, TILE_M, CUTOFF_SCALES * length_scale_m)
    sides = sides_of(kinds, geometry, length_scale_m)
    sectors = _sectors_of(reach.tiles)
    tiles, members, edges = len(reach.tiles), len(reach.members), len(sides.edges)
    words = (members + 1) // 2  # of 64 bits; corners take two for an observation
    size = COLUMNS + 2 * tiles + 1 + words + edges + 4 * n + len(sectors)
    block = np.empty(size + n + n * (n + 1) // 2, np.int64)
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
    block[COUNTS] = at
    for i in range(n):
        share = _share(kinds[i], geometry, i, sides.factor[i], length_scale_m)
        # Nothing finite is surer than this, and infinity times nothing is no number.
        noise = max(noise_variance[i], _LEAST_NOISE * signal_std * signal_std)
        numbers[at + i] = share * signal_std * signal_std / noise
    at += n
    block[at:size] = sectors
    block[WEIGHTS], block[PRECISION] = size, size + n
    for column in (TILES, STARTS, MEMBERS, EDGES, CORNERS, FACTORS, COUNTS, WEIGHTS, PRECISION):
        block[column] = block.ctypes.data + 8 * block[column]
    block[KINDS], block[GEOMETRY] = kinds.ctypes.data, geometry.ctypes.data
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


@vectorised
def _share(
    kind: int, geometry: NDArray[np.float64], i: int, factor: float, length_scale_m: float
) -> float:
    """What the kernel of a shape is multiplied by to be 1 inside it, if it is large."""
    if kind == BOX:
        return 0.25 / factor
    if kind == SEGMENT:
        along = geometry[i, 1, 0] - geometry[i, 0, 0]
        up = geometry[i, 1, 1] - geometry[i, 0, 1]
        return float(_LINE_SHARE * np.sqrt(along * along + up * up) / length_scale_m)
    return 1.0


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


def sector_key(x: _Index, y: _Index) -> _Index:
    """Key of the sector with indices x and y, or keys (n,) of several."""
    return ((x + TILE_OFFSET) << TILE_BITS) | (y + TILE_OFFSET)


def sector_area(key: int) -> Bounds:
    """xmin, ymin, xmax, ymax of the sector with this key, metres."""
    x, y = index_of(key)
    return x * SECTOR_M, y * SECTOR_M, (x + 1) * SECTOR_M, (y + 1) * SECTOR_M
