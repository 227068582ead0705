"""What the experts near one tile of the map say about points in it: the innermost loop of queries.

Points are taken eight at a time, one in each lane of the processor's vectors. A lane's numbers
never touch another's, and observations that are out of its reach count as exact zeros, so a point
gets the same answer in whatever company it is asked.
"""

from __future__ import annotations

import numpy as np
from numba import carray
from numpy.typing import NDArray

from gpom_core.committee import (
    OF_HITS,
    OF_INFORMATION,
    OF_PASSES,
    OF_PRECISION,
    contribution,
)
from gpom_core.jit import compiled, inlined
from gpom_core.kernels import point_segment
from gpom_core.lanes import LANES, above, any_above, load, spread, store
from gpom_core.member import (
    CORNERS,
    COUNTS,
    EDGES,
    FACTORS,
    GEOMETRY,
    INVERSE,
    KINDS,
    MEMBERS,
    PRECISION,
    SIGNAL,
    SIZE,
    WEIGHTS,
)
from gpom_core.pointers import pointer
from gpom_core.rows import BOX, POINT, SEGMENT
from gpom_core.sides import SQRT_HALF
from gpom_core.special import erf, exp_neg

_Floats = NDArray[np.float64]
_Integers = NDArray[np.int64]


@compiled
def tile_sums(
    points: _Floats,
    tables: _Integers,
    entries: _Integers,
    fusion: int,
    negligible: float,
    sums: _Floats,
) -> None:
    """Add the contributions of the experts near a tile to the committee's sums.

    Args:
        points: (n, 2) metres, all in the tile.
        tables: of the `Sector`. entries: (e, 3) those of the tile.
        negligible: kernel values below this share of the signal variance count as zero.
        sums: (n, 4) to add to; columns as in `gpom_core.committee`.
    """
    n, numbers = len(points), tables.view(np.float64)
    room = 1
    for e in range(len(entries)):
        room = max(room, entries[e, 2] - entries[e, 1])
    near, candidates = np.empty(room, np.int64), np.empty(room, np.int64)
    value, work = np.empty((room, LANES)), np.empty((4 * room, LANES))
    x, y = np.empty(LANES), np.empty(LANES)
    mean, explained = np.empty(LANES), np.empty(LANES)
    hits, passes = np.empty(LANES), np.empty(LANES)
    for e in range(len(entries)):
        k = entries[e, 0]
        size, inverse, signal = tables[k, SIZE], numbers[k, INVERSE], numbers[k, SIGNAL]
        kinds = carray(pointer(tables[k, KINDS]), (size,), np.uint8)
        geometry = carray(pointer(tables[k, GEOMETRY]), (size, 2, 2), np.float64)
        corners = carray(pointer(tables[k, CORNERS]), (size, 4), np.int32)
        factors = carray(pointer(tables[k, FACTORS]), (size,), np.float64)
        edges = carray(pointer(tables[k, EDGES]), (4 * size,), np.float64)
        members = carray(pointer(tables[k, MEMBERS]), (entries[e, 2],), np.int32)
        # points first, then segments, then boxes
        points_end, segments_end, end = 0, 0, 0
        for kind in (POINT, SEGMENT, BOX):
            for s in range(entries[e, 1], entries[e, 2]):
                if kinds[members[s]] == kind:
                    candidates[end] = members[s]
                    end += 1
            if kind == POINT:
                points_end = end
            elif kind == SEGMENT:
                segments_end = end
        low_x, high_x, low_y, high_y = _edges_used(candidates[segments_end:end], corners)
        across, up = high_x - low_x, high_y - low_y
        if len(work) < max(across + up, end):
            work = np.empty((max(across + up, end), LANES))
        for start in range(0, n, LANES):
            lanes = min(LANES, n - start)
            for lane in range(LANES):
                w = start + min(lane, lanes - 1)
                x[lane], y[lane] = points[w, 0] * inverse, points[w, 1] * inverse
            found = _near_points(
                candidates[:points_end], geometry, inverse, x, y, negligible, work, near, value
            )
            points_found = found
            for s in range(points_end, segments_end):
                i = candidates[s]
                # rare: only maps that keep beams whole have any
                for lane in range(LANES):
                    work[0, lane] = _segment(geometry[i], x[lane], y[lane], inverse)
                v = load(work.ctypes.data, 0)
                if any_above(v, negligible):
                    near[found] = i
                    store(value.ctypes.data, found, above(v, negligible))
                    found += 1
            if end > segments_end:
                _differences(x, edges[low_x:high_x], work[:across])
                _differences(y, edges[low_y:high_y], work[across : across + up])
                found = _near_boxes(
                    candidates[segments_end:end], corners, factors, low_x, low_y - across,
                    negligible, work, near, value, found,
                )  # fmt: skip
            if found == 0:
                continue
            _counts(
                value.ctypes.data, near.ctypes.data, points_found, found, tables[k, COUNTS], size,
                hits.ctypes.data, passes.ctypes.data,
            )  # fmt: skip
            _ascending(near, value.ctypes.data, found)
            _moments(
                value.ctypes.data, near.ctypes.data, found, tables[k, WEIGHTS],
                tables[k, PRECISION], size, mean.ctypes.data, explained.ctypes.data,
            )  # fmt: skip
            for lane in range(lanes):
                variance = max(signal * (1.0 - signal * explained[lane]), 1e-9 * signal)
                p, q = contribution(fusion, signal * mean[lane], variance, signal)
                here = sums[start + lane]
                here[OF_PRECISION] += p
                here[OF_INFORMATION] += q
                here[OF_HITS] += hits[lane]
                here[OF_PASSES] += passes[lane]


@compiled
def _edges_used(boxes: _Integers, corners: NDArray[np.int32]) -> tuple[int, int, int, int]:
    """First and end of the edges along x, and along y, that some boxes have."""
    low_x, high_x, low_y, high_y = 2**30, -1, 2**30, -1
    for s in range(len(boxes)):
        i = boxes[s]
        low_x = min(low_x, corners[i, 0])
        high_x = max(high_x, corners[i, 1])
        low_y = min(low_y, corners[i, 2])
        high_y = max(high_y, corners[i, 3])
    if high_x < 0:
        return 0, 0, 0, 0
    return low_x, high_x + 1, low_y, high_y + 1


@compiled
def _segment(shape: _Floats, x: float, y: float, inverse: float) -> float:
    point, scale = np.empty(2), np.empty(2)
    point[0], point[1] = x / inverse, y / inverse
    scale[:] = inverse
    return point_segment(shape, point, scale)


@compiled
def _near_points(
    candidates: _Integers, geometry: _Floats, inverse: float, x: _Floats, y: _Floats,
    negligible: float, work: _Floats, near: _Integers, value: _Floats,
) -> int:  # fmt: skip
    """Candidates of kind point that reach any lane: numbers and kernel values; how many."""
    address = work.ctypes.data
    px, py, half = load(x.ctypes.data, 0), load(y.ctypes.data, 0), spread(-0.5)
    for s in range(len(candidates)):
        i = candidates[s]
        dx = px - spread(geometry[i, 0, 0] * inverse)
        dy = py - spread(geometry[i, 0, 1] * inverse)
        store(address, s, half * (dx * dx + dy * dy))
    flat = work.reshape(-1)
    for t in range(len(candidates) * LANES):
        flat[t] = exp_neg(flat[t])
    found = 0
    for s in range(len(candidates)):
        v = load(address, s)
        if any_above(v, negligible):
            near[found] = candidates[s]
            store(value.ctypes.data, found, above(v, negligible))
            found += 1
    return found


@compiled
def _differences(x: _Floats, edges: _Floats, out: _Floats) -> None:
    """Error functions of the lanes of x minus each edge."""
    px, address = load(x.ctypes.data, 0) * spread(SQRT_HALF), out.ctypes.data
    for t in range(len(edges)):
        store(address, t, px - spread(edges[t]))
    flat = out.reshape(-1)
    for t in range(flat.size):
        flat[t] = erf(flat[t])


@compiled
def _near_boxes(
    boxes: _Integers, corners: NDArray[np.int32], factors: _Floats, low_x: int, low_y: int,
    negligible: float, work: _Floats, near: _Integers, value: _Floats, found: int,
) -> int:  # fmt: skip
    """As `_near_points` for boxes, whose `_differences` are in `work`; appends to `found`."""
    address, kept = work.ctypes.data, value.ctypes.data
    for s in range(len(boxes)):
        i = boxes[s]
        across = load(address, corners[i, 0] - low_x) - load(address, corners[i, 1] - low_x)
        up = load(address, corners[i, 2] - low_y) - load(address, corners[i, 3] - low_y)
        v = spread(factors[i]) * across * up
        if any_above(v, negligible):
            near[found] = i
            store(kept, found, above(v, negligible))
            found += 1
    return found


@compiled
def _ascending(near: _Integers, value: int, found: int) -> None:
    """Sort what is near by number, with its values; almost always it is."""
    for a in range(1, found):
        b = a
        while b > 0 and near[b - 1] > near[b]:
            near[b - 1], near[b] = near[b], near[b - 1]
            v, w = load(value, b - 1), load(value, b)
            store(value, b - 1, w)
            store(value, b, v)
            b -= 1


@compiled
def _moments(
    value: int, near: int, found: int, weights: int, packed: int, size: int,
    mean: int, explained: int,
) -> None:  # fmt: skip
    """Sums over the near observations, k' alpha and k' K^-1 k; all arrays by address.

    K^-1 is symmetric and packed: what is right of the diagonal counts twice.
    """
    index = carray(pointer(near), (found,), np.int64)
    weight = carray(pointer(weights), (size,), np.float64)
    rows = carray(pointer(packed), (size * (size + 1) // 2,), np.float64)
    total, both = spread(0.0), spread(0.0)
    for a in range(0, found - 1, 2):  # two rows at once: each value is read half as often
        i, j = index[a], index[a + 1]
        one, other = _row(i, size), _row(j, size)
        v, w = load(value, a), load(value, a + 1)
        # In this order whoever is whose neighbour: what is out of a lane's reach changes nothing.
        first, second = spread(rows[one + j]) * w, spread(0.0)
        for b in range(a + 2, found):
            u, column = load(value, b), index[b]
            first = first + spread(rows[one + column]) * u
            second = second + spread(rows[other + column]) * u
        total = total + spread(weight[i]) * v + spread(weight[j]) * w
        both = both + v * (first + first + spread(rows[one + i]) * v)
        both = both + w * (second + second + spread(rows[other + j]) * w)
    if found % 2 == 1:
        i = index[found - 1]
        v = load(value, found - 1)
        total = total + spread(weight[i]) * v
        both = both + v * (spread(rows[_row(i, size) + i]) * v)
    store(mean, 0, total)
    store(explained, 0, both)


@inlined
def _row(i: int, size: int) -> int:
    """Where column 0 of row i of a packed triangle would be."""
    return i * size - i * (i + 1) // 2


@compiled
def _counts(
    value: int, near: int, points: int, found: int, counts: int, size: int,
    hits: int, passes: int,
) -> None:  # fmt: skip
    """What the evidence at the place itself weighs: hits close by, areas the place is in.

    Hits count within a sixth of a length scale: the power 32 of their kernel is narrower by
    sqrt(32). All arrays by address; the first `points` of the near observations are hits.
    """
    index = carray(pointer(near), (found,), np.int64)
    count = carray(pointer(counts), (size,), np.float64)
    close, inside = spread(0.0), spread(0.0)
    for a in range(points):
        v = load(value, a)
        v = v * v
        v = v * v
        v = v * v
        v = v * v
        close = close + spread(count[index[a]]) * (v * v)
    for a in range(points, found):
        inside = inside + spread(count[index[a]]) * load(value, a)
    store(hits, 0, close)
    store(passes, 0, inside)
