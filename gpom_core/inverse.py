"""Inverse of a symmetric positive definite matrix, and its determinant; compiled.

LAPACK is made for matrices of hundreds of rows: at the 60 to 150 of an expert its factor and
inverse take twice as long as this. The sweep operator (Goodnight 1979) turns eight rows at a time
into their part of the inverse, in place, by way of their Cholesky factor, so that errors are those
of Cholesky's method. What it costs is one product over vectors of eight, n^3 / 2 in all.
"""

from __future__ import annotations

from typing import Final

import numpy as np
from numpy.typing import NDArray

from gpom_core.jit import compiled
from gpom_core.lanes import LANES, load, spread, store
from gpom_core.lapack import addresses as lapack_addresses
from gpom_core.lapack import inverse_by_lapack

_Floats = NDArray[np.float64]

LARGEST_SWEPT: Final = 512  # rows; beyond, the matrix leaves the cache and LAPACK is as fast
_NOT_NEEDED = np.zeros(2, np.int64)


def addresses_for(rows: int) -> NDArray[np.int64]:
    """What `inverse_spd` has to be given for a matrix of so many rows, (2,)."""
    return lapack_addresses() if rows > LARGEST_SWEPT else _NOT_NEEDED


@compiled
def inverse_spd(k: _Floats, addresses: NDArray[np.int64]) -> float:
    """Replace a symmetric positive definite matrix (n, n) by its inverse.

    Args:
        k: C-ordered, only its upper triangle is read.
        addresses: `addresses_for(n)`.

    Returns:
        The log determinant, or NaN when `k` is not positive definite.
    """
    n = len(k)
    if n > LARGEST_SWEPT:
        return inverse_by_lapack(k, addresses)
    a = np.empty((padded(n), padded(n)))
    _copy_in(k, a)
    log_determinant = sweep(a, n)
    _copy_out(a, k)
    return log_determinant


@compiled
def padded(n: int) -> int:
    """Rows of the matrix that `sweep` takes for one of n rows: whole vectors."""
    return (n + LANES - 1) // LANES * LANES


@compiled
def sweep(a: _Floats, n: int) -> float:
    """Turn a matrix (n, n), symmetric and positive definite, into minus its inverse, in place.

    Args:
        a: (`padded(n)`, `padded(n)`), of which the upper triangle of the first n rows and columns
            is read and written. The others become garbage.

    Returns:
        The log determinant, or NaN when the matrix is not positive definite.
    """
    edge = padded(n)
    blocks = edge // LANES
    for i in range(edge):  # the identity beyond n
        for j in range(max(n, i), edge):
            a[i, j] = 1.0 if i == j else 0.0
    corner, shares = np.empty((LANES, LANES)), np.empty(LANES)
    half, whole = np.empty((LANES, edge)), np.empty((LANES, edge))
    log_determinant = 0.0
    for block in range(blocks):
        _take(a, block, half, corner)
        gained = _factorise(corner, shares)
        if not gained < np.inf:
            return np.nan
        log_determinant += gained
        _solve(corner, shares, half.ctypes.data, whole.ctypes.data, blocks)
        _subtract(a.ctypes.data, blocks, block, half)
        _put(a, block, whole)
    return log_determinant


@compiled
def solve_and_pack(
    a: _Floats, y: _Floats, addresses: NDArray[np.int64], x: _Floats, packed: _Floats
) -> float:
    """Invert a symmetric positive definite matrix A (n, n) and solve A x = y.

    Args:
        a: upper triangle of A, as `sweep` takes it; destroyed.
        y: (n,). addresses: `addresses_for(n)`.
        x: (n,), out. packed: (n (n + 1) / 2,) rows of the inverse's upper triangle, out.

    Returns:
        The log determinant, or NaN when A is not positive definite.
    """
    n = len(y)
    if n > LARGEST_SWEPT:
        k = a[:n, :n].copy()
        log_determinant = inverse_by_lapack(k, addresses)
        for i in range(n):
            for j in range(i, n):
                a[i, j] = -k[i, j]
    else:
        log_determinant = sweep(a, n)
    _pack(a, y, x, packed)
    return log_determinant


@compiled
def _pack(a: _Floats, y: _Floats, x: _Floats, packed: _Floats) -> None:
    """Write minus the upper triangle of `a`, packed, and its product with y, in one pass."""
    n, blocks = len(y), len(a) // LANES
    seen, sums, kept = np.zeros(blocks * LANES), np.zeros(blocks * LANES), np.empty(LANES)
    seen[:n] = y
    source, target = a.ctypes.data, packed.ctypes.data
    there, here = seen.ctypes.data, sums.ctypes.data
    whole, zero, at = n // LANES, spread(0.0), 0
    for i in range(n):
        block = i // LANES
        end = min(block * LANES + LANES, n)
        mine = -a[i, i] * y[i]
        packed[at] = -a[i, i]
        for j in range(i + 1, end):
            value = -a[i, j]
            packed[at + j - i] = value
            mine += value * seen[j]
            sums[j] += value * y[i]
        total, again = zero, spread(y[i])
        for chunk in range(block + 1, whole):
            values = zero - load(source, i * blocks + chunk)
            store(target + 8 * (at - i), chunk, values)
            total = total + values * load(there, chunk)
            store(here, chunk, load(here, chunk) + values * again)
        for j in range(max(whole * LANES, end), n):
            value = -a[i, j]
            packed[at + j - i] = value
            mine += value * seen[j]  # not y: while it is read here it is not freed
            sums[j] += value * y[i]
        store(kept.ctypes.data, 0, total)
        for p in range(LANES):
            mine += kept[p]
        sums[i] += mine
        at += n - i
    x[:] = sums[:n]


def unpacked(packed: _Floats, n: int) -> _Floats:
    """The symmetric matrix (n, n) whose upper triangle, row by row, is `packed`."""
    out = np.empty((n, n))
    rows, columns = np.triu_indices(n)
    out[rows, columns] = out[columns, rows] = packed
    return out


@compiled
def _copy_in(k: _Floats, a: _Floats) -> None:
    n, edge = len(k), len(a)
    source, target = k.ctypes.data, a.ctypes.data
    whole, blocks = n // LANES, edge // LANES
    for i in range(n):
        for chunk in range(i // LANES, whole):
            store(target, i * blocks + chunk, load(source + 8 * i * n, chunk))
        for j in range(whole * LANES, n):
            a[i, j] = k[i, j]


@compiled
def _copy_out(a: _Floats, k: _Floats) -> None:
    """Write minus the upper triangle, and its mirror image, block by block."""
    n, edge = len(k), len(a)
    source, target = a.ctypes.data, k.ctypes.data
    whole, blocks = n // LANES, edge // LANES
    zero = spread(0.0)
    block = np.empty((LANES, LANES))
    kept = block.ctypes.data
    for chunk in range(whole):
        for row in range(chunk):
            for p in range(LANES):
                i = row * LANES + p
                values = zero - load(source, i * blocks + chunk)
                store(target + 8 * i * n, chunk, values)
                store(kept, p, values)
            for q in range(LANES):
                mirrored = k[chunk * LANES + q, row * LANES : row * LANES + LANES]
                for p in range(LANES):
                    mirrored[p] = block[p, q]
    for chunk in range(blocks):
        low, high = chunk * LANES, min(chunk * LANES + LANES, n)
        for j in range(low, high):
            for i in range(0 if chunk == whole else low, j + 1):
                k[i, j] = -a[i, j]
                k[j, i] = -a[i, j]


@compiled
def _take(a: _Floats, block: int, rows: _Floats, corner: _Floats) -> None:
    """Copy a block's rows (8, n), from the upper triangle, and where they cross its columns.

    There the rows become the identity, so that solving makes it the inverse of the corner.
    """
    at, blocks = block * LANES, len(a) // LANES
    source, target = a.ctypes.data, rows.ctypes.data
    for i in range(at):
        for p in range(LANES):
            rows[p, i] = a[i, at + p]
    for p in range(LANES):
        for q in range(LANES):
            corner[p, q] = a[at + q, at + p] if q < p else a[at + p, at + q]
            rows[p, at + q] = 1.0 if p == q else 0.0
        for chunk in range(block + 1, blocks):
            store(target, p * blocks + chunk, load(source, (at + p) * blocks + chunk))


@compiled
def _factorise(corner: _Floats, shares: _Floats) -> float:
    """Cholesky's lower factor of a block (8, 8), in place; log determinant, NaN if it has none.

    Args:
        shares: (8,) one over the diagonal of the factor, out.
    """
    log_determinant = 0.0
    for p in range(LANES):
        pivot = corner[p, p]
        for q in range(p):
            pivot -= corner[p, q] * corner[p, q]
        if not 0.0 < pivot < np.inf:
            return np.nan
        log_determinant += np.log(pivot)
        shares[p] = 1.0 / np.sqrt(pivot)
        for i in range(p + 1, LANES):
            value = corner[i, p]
            for q in range(p):
                value -= corner[i, q] * corner[p, q]
            corner[i, p] = value * shares[p]
    return log_determinant


@compiled
def _solve(  # noqa: PLR0915 - spelled out
    corner: _Floats, shares: _Floats, half: int, whole: int, blocks: int
) -> None:
    """Solve with the factor, in place, and with its transpose, into `whole`; (8, n) by address.

    With the factor and not with the inverse of the corner: what is subtracted later would have
    the square of its condition in the error.
    """
    # Spelled out, so that rows stay in registers: the sweep takes a seventh less than with loops.
    for chunk in range(blocks):
        a0 = load(half, chunk)
        a0 = a0 * spread(shares[0])
        a1 = load(half, 1 * blocks + chunk)
        a1 = a1 - spread(corner[1, 0]) * a0
        a1 = a1 * spread(shares[1])
        a2 = load(half, 2 * blocks + chunk)
        a2 = a2 - spread(corner[2, 0]) * a0
        a2 = a2 - spread(corner[2, 1]) * a1
        a2 = a2 * spread(shares[2])
        a3 = load(half, 3 * blocks + chunk)
        a3 = a3 - spread(corner[3, 0]) * a0
        a3 = a3 - spread(corner[3, 1]) * a1
        a3 = a3 - spread(corner[3, 2]) * a2
        a3 = a3 * spread(shares[3])
        a4 = load(half, 4 * blocks + chunk)
        a4 = a4 - spread(corner[4, 0]) * a0
        a4 = a4 - spread(corner[4, 1]) * a1
        a4 = a4 - spread(corner[4, 2]) * a2
        a4 = a4 - spread(corner[4, 3]) * a3
        a4 = a4 * spread(shares[4])
        a5 = load(half, 5 * blocks + chunk)
        a5 = a5 - spread(corner[5, 0]) * a0
        a5 = a5 - spread(corner[5, 1]) * a1
        a5 = a5 - spread(corner[5, 2]) * a2
        a5 = a5 - spread(corner[5, 3]) * a3
        a5 = a5 - spread(corner[5, 4]) * a4
        a5 = a5 * spread(shares[5])
        a6 = load(half, 6 * blocks + chunk)
        a6 = a6 - spread(corner[6, 0]) * a0
        a6 = a6 - spread(corner[6, 1]) * a1
        a6 = a6 - spread(corner[6, 2]) * a2
        a6 = a6 - spread(corner[6, 3]) * a3
        a6 = a6 - spread(corner[6, 4]) * a4
        a6 = a6 - spread(corner[6, 5]) * a5
        a6 = a6 * spread(shares[6])
        a7 = load(half, 7 * blocks + chunk)
        a7 = a7 - spread(corner[7, 0]) * a0
        a7 = a7 - spread(corner[7, 1]) * a1
        a7 = a7 - spread(corner[7, 2]) * a2
        a7 = a7 - spread(corner[7, 3]) * a3
        a7 = a7 - spread(corner[7, 4]) * a4
        a7 = a7 - spread(corner[7, 5]) * a5
        a7 = a7 - spread(corner[7, 6]) * a6
        a7 = a7 * spread(shares[7])
        store(half, 0 * blocks + chunk, a0)
        store(half, 1 * blocks + chunk, a1)
        store(half, 2 * blocks + chunk, a2)
        store(half, 3 * blocks + chunk, a3)
        store(half, 4 * blocks + chunk, a4)
        store(half, 5 * blocks + chunk, a5)
        store(half, 6 * blocks + chunk, a6)
        store(half, 7 * blocks + chunk, a7)
        a7 = a7 * spread(shares[7])
        a6 = a6 - spread(corner[7, 6]) * a7
        a6 = a6 * spread(shares[6])
        a5 = a5 - spread(corner[7, 5]) * a7
        a5 = a5 - spread(corner[6, 5]) * a6
        a5 = a5 * spread(shares[5])
        a4 = a4 - spread(corner[7, 4]) * a7
        a4 = a4 - spread(corner[6, 4]) * a6
        a4 = a4 - spread(corner[5, 4]) * a5
        a4 = a4 * spread(shares[4])
        a3 = a3 - spread(corner[7, 3]) * a7
        a3 = a3 - spread(corner[6, 3]) * a6
        a3 = a3 - spread(corner[5, 3]) * a5
        a3 = a3 - spread(corner[4, 3]) * a4
        a3 = a3 * spread(shares[3])
        a2 = a2 - spread(corner[7, 2]) * a7
        a2 = a2 - spread(corner[6, 2]) * a6
        a2 = a2 - spread(corner[5, 2]) * a5
        a2 = a2 - spread(corner[4, 2]) * a4
        a2 = a2 - spread(corner[3, 2]) * a3
        a2 = a2 * spread(shares[2])
        a1 = a1 - spread(corner[7, 1]) * a7
        a1 = a1 - spread(corner[6, 1]) * a6
        a1 = a1 - spread(corner[5, 1]) * a5
        a1 = a1 - spread(corner[4, 1]) * a4
        a1 = a1 - spread(corner[3, 1]) * a3
        a1 = a1 - spread(corner[2, 1]) * a2
        a1 = a1 * spread(shares[1])
        a0 = a0 - spread(corner[7, 0]) * a7
        a0 = a0 - spread(corner[6, 0]) * a6
        a0 = a0 - spread(corner[5, 0]) * a5
        a0 = a0 - spread(corner[4, 0]) * a4
        a0 = a0 - spread(corner[3, 0]) * a3
        a0 = a0 - spread(corner[2, 0]) * a2
        a0 = a0 - spread(corner[1, 0]) * a1
        a0 = a0 * spread(shares[0])
        store(whole, 0 * blocks + chunk, a0)
        store(whole, 1 * blocks + chunk, a1)
        store(whole, 2 * blocks + chunk, a2)
        store(whole, 3 * blocks + chunk, a3)
        store(whole, 4 * blocks + chunk, a4)
        store(whole, 5 * blocks + chunk, a5)
        store(whole, 6 * blocks + chunk, a6)
        store(whole, 7 * blocks + chunk, a7)


@compiled
def _subtract(a: int, blocks: int, block: int, rows: _Floats) -> None:
    """Subtract the product of rows (8, n) with themselves, in the upper triangle, off the block."""
    for i in range(0, blocks * LANES, 4):
        if i // LANES == block:
            continue
        for chunk in range(i // LANES, blocks):
            if chunk == block:
                continue
            at = i * blocks + chunk
            u, v = load(a, at), load(a, at + blocks)
            w, x = load(a, at + 2 * blocks), load(a, at + 3 * blocks)
            for p in range(LANES):
                row = load(rows.ctypes.data, p * blocks + chunk)
                u = u - spread(rows[p, i]) * row
                v = v - spread(rows[p, i + 1]) * row
                w = w - spread(rows[p, i + 2]) * row
                x = x - spread(rows[p, i + 3]) * row
            store(a, at, u)
            store(a, at + blocks, v)
            store(a, at + 2 * blocks, w)
            store(a, at + 3 * blocks, x)


@compiled
def _put(a: _Floats, block: int, rows: _Floats) -> None:
    """Write what became of a block's rows (8, n) into the upper triangle."""
    at, blocks = block * LANES, len(a) // LANES
    target, source = a.ctypes.data, rows.ctypes.data
    for i in range(at):
        for p in range(LANES):
            a[i, at + p] = rows[p, i]
    for p in range(LANES):
        for q in range(LANES):
            a[at + p, at + q] = -rows[p, at + q]
        for chunk in range(block + 1, blocks):
            store(target, (at + p) * blocks + chunk, load(source, p * blocks + chunk))
