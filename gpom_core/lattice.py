"""The committee's sums between the nodes of a lattice: filling one tile of it, and reading it.

Contributions of experts add up, so their sums are functions of place that can be interpolated. Each
tile has as many nodes as its evidence needs.
"""

from __future__ import annotations

from typing import Final

import numpy as np
from numba import carray
from numpy.typing import NDArray

from gpom_core.committee import OF_HITS, OF_INFORMATION, OF_PASSES, OF_PRECISION, SUMS
from gpom_core.jit import compiled, vectorised
from gpom_core.link import probability, take_logarithms
from gpom_core.member import SECTOR_SHIFT, SECTOR_TILES, TILE_M, TILES_IN_SECTOR
from gpom_core.opinions import tile_sums
from gpom_core.pages import INTERVAL_BITS, NOT_FILLED, NOTHING
from gpom_core.pointers import pointer
from gpom_core.reach import tile_key

COARSEST: Final = 8  # intervals along the edge of a tile
FINEST: Final = 32

_Floats = NDArray[np.float64]
_Integers = NDArray[np.int64]


@compiled
def fill_tile(
    corner: _Floats,
    tables: _Integers,
    entries: _Integers,
    fusion: int,
    negligible: float,
    prior_variance: float,
    weights: _Floats,
    tolerance: float,
) -> NDArray[np.float32]:
    """Nodes of one tile, as coarse as the tolerance allows.

    Interpolation errs most in the middle of a cell, and there it is compared with the exact sums.

    Args:
        corner: (2,) low corner of the tile, metres.
        tables: of the `Sector`. entries: (e, 3) those of the tile.
        weights: (6,) of the `Link`. tolerance: of the probability.

    Returns:
        (n + 1, n + 1, 4) the committee's sums as `Field.sums` has them; axis 0 is x.
    """
    n = COARSEST
    while True:
        nodes = _lattice(corner, n, n + 1, 0.0, tables, entries, fusion, negligible)
        if n >= FINEST:
            break
        error = _worst_error(
            nodes, _lattice(corner, n, n, 0.5, tables, entries, fusion, negligible),
            1.0 / prior_variance, weights,
        )  # fmt: skip
        if error <= tolerance:
            break
        n *= 2 if error <= 4.0 * tolerance else 4  # each halving quarters the error
        n = min(n, FINEST)
    return nodes.astype(np.float32)


@compiled
def _lattice(
    corner: _Floats, n: int, edge: int, shift: float, tables: _Integers,
    entries: _Integers, fusion: int, negligible: float,
) -> _Floats:  # fmt: skip
    """Sums (edge, edge, 4) at the nodes of a lattice of n intervals a tile, shifted by a share."""
    points = np.empty((edge * edge, 2))
    for i in range(edge):
        for j in range(edge):
            points[i * edge + j, 0] = corner[0] + (i + shift) * (TILE_M / n)
            points[i * edge + j, 1] = corner[1] + (j + shift) * (TILE_M / n)
    sums = np.zeros((edge * edge, SUMS))
    tile_sums(points, tables, entries, fusion, negligible, sums)
    take_logarithms(sums)
    return sums.reshape(edge, edge, SUMS)


@compiled
def _worst_error(nodes: _Floats, exact: _Floats, prior: float, weights: _Floats) -> float:
    """Largest difference of probabilities in the middles of cells.

    Args:
        nodes: (n + 1, n + 1, 4). exact: (n, n, 4). prior: its precision.
    """
    worst = 0.0
    for i in range(len(exact)):
        for j in range(len(exact)):
            four = nodes[i, j] + nodes[i + 1, j] + nodes[i, j + 1] + nodes[i + 1, j + 1]
            between = _probability(0.25 * four, prior, weights)
            worst = max(worst, abs(between - _probability(exact[i, j], prior, weights)))
    return worst


@vectorised
def _probability(sums: _Floats, prior: float, weights: _Floats) -> float:
    total = sums[OF_PRECISION] + prior
    mean, left = sums[OF_INFORMATION] / total, min(prior / total, 1.0)
    return float(probability(mean, left, sums[OF_HITS], sums[OF_PASSES], weights))


@compiled
def slots_of(keys: _Integers) -> _Integers:
    """Hash index of sector keys (k,): a power of two of slots with a number or -1."""
    size = 4
    while size < 2 * len(keys):
        size *= 2
    slots = np.full(size, -1, np.int64)
    for i in range(len(keys)):
        at = _slot(keys[i], size)
        while slots[at] >= 0:
            at = (at + 1) & (size - 1)
        slots[at] = i
    return slots


@vectorised
def _slot(key: int, size: int) -> int:
    mixed = key * 0x9E3779B97F4A7C1 + (key >> 31) * 0x632BE59BD9B4E019
    return ((mixed ^ (mixed >> 29)) >> 7) & (size - 1)


@compiled
def interpolate(
    points: _Floats,
    which: _Integers,
    bounds: _Floats,
    keys: _Integers,
    slots: _Integers,
    books: _Integers,
    tick: int,
    sums: _Floats,
    late: _Integers,
) -> int:
    """Add the field's sums at points[which]; the prior is not among them.

    Args:
        points: (n, 2) metres. which: numbers of points.
        bounds: (4,) xmin, ymin, xmax, ymax; beyond all is unknown.
        keys: (k,) of the sectors. slots: `slots_of` them.
        books: (k, 2) addresses of each sector's arrays (tiles,): `Pages.marks`, and the tick of
            the last use, which is written.
        sums: (n, 4) to add to.
        late: (n,) numbers of points whose tile is not filled are written here.

    Returns:
        How many points are late.
    """
    waiting = 0
    last, book = -1, -1
    for w in range(len(which)):
        point = which[w]
        x, y = points[point, 0], points[point, 1]
        if not (bounds[0] <= x <= bounds[2] and bounds[1] <= y <= bounds[3]):
            continue
        fx, fy = np.floor(x / TILE_M), np.floor(y / TILE_M)
        ix, iy = int(fx), int(fy)
        key = tile_key(ix >> SECTOR_SHIFT, iy >> SECTOR_SHIFT)
        if key != last:
            last, book = key, _find(key, keys, slots)
        if book < 0:
            continue
        tile = (ix & (SECTOR_TILES - 1)) * SECTOR_TILES + (iy & (SECTOR_TILES - 1))
        mark = carray(pointer(books[book, 0]), (TILES_IN_SECTOR,), np.int64)[tile]
        if mark == NOTHING:
            continue
        if mark == NOT_FILLED:
            late[waiting] = point
            waiting += 1
            continue
        carray(pointer(books[book, 1]), (TILES_IN_SECTOR,), np.int64)[tile] = tick
        n = mark & ((1 << INTERVAL_BITS) - 1)
        u, v = (x / TILE_M - fx) * n, (y / TILE_M - fy) * n
        _between(mark >> INTERVAL_BITS, n, u, v, sums, point)
    return waiting


@vectorised
def _find(key: int, keys: _Integers, slots: _Integers) -> int:
    size = len(slots)
    at = _slot(key, size)
    while slots[at] >= 0:
        if keys[slots[at]] == key:
            return int(slots[at])
        at = (at + 1) & (size - 1)
    return -1


@vectorised
def _between(address: int, n: int, u: float, v: float, sums: _Floats, point: int) -> None:
    """Add what is between the nodes, (u, v) intervals from the corner of a tile of n."""
    nodes = carray(pointer(address), (n + 1, n + 1, SUMS), np.float32)
    i, j = min(int(u), n - 1), min(int(v), n - 1)
    a, b = np.float32(u - i), np.float32(v - j)
    for column in range(SUMS):
        low = nodes[i, j, column] + b * (nodes[i, j + 1, column] - nodes[i, j, column])
        high = nodes[i + 1, j, column] + b * (nodes[i + 1, j + 1, column] - nodes[i + 1, j, column])
        sums[point, column] += low + a * (high - low)
