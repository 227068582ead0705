"""The committee's sums between the nodes of a lattice: filling one tile of it, and reading it.

Contributions of experts add up, so their sums, precision and information, are functions of place
that can be interpolated. Each tile has as many nodes as its evidence needs.
"""

from __future__ import annotations

from typing import Final

import numpy as np
from numba import carray
from numpy.typing import NDArray

from gpom_core.jit import compiled, vectorised
from gpom_core.link import probability
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
        weights: (5,) of the `Link`. tolerance: of the probability.

    Returns:
        (n + 1, n + 1, 2) precision and information of the experts, without the prior; axis 0 is x.
    """
    n = COARSEST
    while True:
        precision, information = _lattice(
            corner, n, n + 1, 0.0, tables, entries, fusion, negligible
        )
        if n >= FINEST:
            break
        error = _worst_error(
            _middles(precision), _middles(information),
            _lattice(corner, n, n, 0.5, tables, entries, fusion, negligible),
            1.0 / prior_variance, weights,
        )  # fmt: skip
        if error <= tolerance:
            break
        n *= 2 if error <= 4.0 * tolerance else 4  # each halving quarters the error
        n = min(n, FINEST)
    out = np.empty((n + 1, n + 1, 2), np.float32)
    out[:, :, 0] = precision
    out[:, :, 1] = information
    return out


@compiled
def _lattice(
    corner: _Floats, n: int, edge: int, shift: float, tables: _Integers,
    entries: _Integers, fusion: int, negligible: float,
) -> tuple[_Floats, _Floats]:  # fmt: skip
    """Sums at the nodes (edge, edge) of a lattice of n intervals a tile, shifted by a share."""
    points = np.empty((edge * edge, 2))
    for i in range(edge):
        for j in range(edge):
            points[i * edge + j, 0] = corner[0] + (i + shift) * (TILE_M / n)
            points[i * edge + j, 1] = corner[1] + (j + shift) * (TILE_M / n)
    precision, information = np.zeros(edge * edge), np.zeros(edge * edge)
    tile_sums(points, tables, entries, fusion, negligible, precision, information)
    return precision.reshape(edge, edge), information.reshape(edge, edge)


@compiled
def _middles(nodes: _Floats) -> _Floats:
    return 0.25 * (nodes[:-1, :-1] + nodes[1:, :-1] + nodes[:-1, 1:] + nodes[1:, 1:])


@compiled
def _worst_error(
    precision: _Floats, information: _Floats, exact: tuple[_Floats, _Floats],
    prior: float, weights: _Floats,
) -> float:  # fmt: skip
    """Largest difference of probabilities; `prior` is the precision of the prior."""
    worst = 0.0
    for i in range(len(precision)):
        for j in range(len(precision)):
            total, truth = precision[i, j] + prior, exact[0][i, j] + prior
            p = probability(information[i, j] / total, min(prior / total, 1.0), weights)
            q = probability(exact[1][i, j] / truth, min(prior / truth, 1.0), weights)
            worst = max(worst, abs(p - q))
    return worst


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
    precision: _Floats,
    information: _Floats,
    late: _Integers,
) -> int:
    """Add the field's sums at points[which]; the prior is not among them.

    Args:
        points: (n, 2) metres. which: numbers of points.
        bounds: (4,) xmin, ymin, xmax, ymax; beyond all is unknown.
        keys: (k,) of the sectors. slots: `slots_of` them.
        books: (k, 2) addresses of each sector's arrays (tiles,): `Pages.marks`, and the tick of
            the last use, which is written.
        precision, information: (n,) sums to add to.
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
        p, i = _between(mark >> INTERVAL_BITS, n, (x / TILE_M - fx) * n, (y / TILE_M - fy) * n)
        precision[point] += p
        information[point] += i
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
def _between(address: int, n: int, u: float, v: float) -> tuple[float, float]:
    """Bilinear interpolation at (u, v) intervals from the corner of a tile of n."""
    nodes = carray(pointer(address), (2 * (n + 1) * (n + 1),), np.float32)
    i, j = min(int(u), n - 1), min(int(v), n - 1)
    a, b = u - i, v - j
    low = 2 * (i * (n + 1) + j)
    high = low + 2 * (n + 1)
    first = (1.0 - a) * (1.0 - b), (1.0 - a) * b, a * (1.0 - b), a * b
    precision = (
        first[0] * nodes[low] + first[1] * nodes[low + 2]
        + first[2] * nodes[high] + first[3] * nodes[high + 2]
    )  # fmt: skip
    information = (
        first[0] * nodes[low + 1] + first[1] * nodes[low + 3]
        + first[2] * nodes[high + 1] + first[3] * nodes[high + 3]
    )  # fmt: skip
    return precision, information
