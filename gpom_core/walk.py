"""Beams walking through the cells of the lattice: how far they went through each, and no more.

The innermost loop of ingest. It knows nothing of rows: lengths of all beams of a scan are added up
in a window of plain numbers first, so that each cell is looked up once a scan and not once a beam.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from gpom_core.jit import compiled
from gpom_core.tiles import TILE_AREA, TILE_CELLS, place_in_tile

WINDOW_TILES = 128  # each way; beams that go farther are walked window by window


class Crossed(NamedTuple):
    """What beams crossed in a window of w tiles.

    Attributes:
        corner: (2,) index of its lowest tile. breadth: tiles of the window along y.
        length_m: (w, 64) summed over all beams, by place in the tile.
        beam: (w,) the last beam that went through the tile, or NONE.
    """

    corner: tuple[int, int]
    breadth: int
    length_m: NDArray[np.float64]
    beam: NDArray[np.int32]


@compiled
def span(
    origin: NDArray[np.float64],
    direction: NDArray[np.float64],
    free_m: NDArray[np.float64],
    cell_m: float,
) -> tuple[int, int, int, int]:
    """Lowest tile that the beams reach, x and y, and how many they span each way; 0, 0 if none."""
    low_x, high_x = np.inf, -np.inf
    low_y, high_y = np.inf, -np.inf
    for b in range(len(free_m)):
        if free_m[b] > 0.0:
            x, y = origin[0] + free_m[b] * direction[b, 0], origin[1] + free_m[b] * direction[b, 1]
            low_x, high_x = min(low_x, x), max(high_x, x)
            low_y, high_y = min(low_y, y), max(high_y, y)
    if not low_x < np.inf:
        return 0, 0, 0, 0
    edge = TILE_CELLS * cell_m
    tx, ty = (
        int(np.floor(min(low_x, origin[0]) / edge)),
        int(np.floor(min(low_y, origin[1]) / edge)),
    )
    nx = int(np.floor(max(high_x, origin[0]) / edge)) - tx + 1
    ny = int(np.floor(max(high_y, origin[1]) / edge)) - ty + 1
    return tx, ty, nx, ny


@compiled
def window_room(shape: tuple[int, int]) -> int:
    """Tiles of the largest window for beams that span so many, x and y."""
    return min(shape[0], WINDOW_TILES) * min(shape[1], WINDOW_TILES)


@compiled
def crossed_in(
    corner: tuple[int, int],
    shape: tuple[int, int],
    length_m: NDArray[np.float64],
    beam: NDArray[np.int32],
) -> Crossed:
    """What `walk` added up in a window."""
    w = shape[0] * shape[1]
    return Crossed(corner, shape[1], length_m[: w * TILE_AREA].reshape(w, TILE_AREA), beam[:w])


@compiled
def _steps_to(n: int, along_x: bool, breadth: int) -> NDArray[np.int64]:
    """Place of cell i - 1 in the window, as far as one axis says; both ends are there twice.

    Rounding may lead a beam one cell past the edge of the window, with nothing left to add.
    """
    out = np.empty(n * TILE_CELLS + 2, np.int64)
    for i in range(n * TILE_CELLS):
        if along_x:
            out[i + 1] = (i // TILE_CELLS) * breadth * TILE_AREA + place_in_tile(i, 0)
        else:
            out[i + 1] = (i // TILE_CELLS) * TILE_AREA + place_in_tile(0, i)
    out[0] = out[1]
    out[-1] = out[-2]
    return out


@compiled
def walk(
    origin: NDArray[np.float64],
    direction: NDArray[np.float64],
    free_m: NDArray[np.float64],
    corner: tuple[int, int],
    shape: tuple[int, int],
    cell_m: float,
    length_m: NDArray[np.float64],
    beam: NDArray[np.int32],
) -> None:
    """Add up how far beams go through each cell of a window.

    Cell walking after Amanatides & Woo, "A fast voxel traversal algorithm" (1987), without a
    branch on which way to go.

    Args:
        origin: (2,) sensor. direction: (n, 2) unit. free_m: (n,) length of each free part.
        corner: index of the lowest tile of the window. shape: tiles along x and y.
        length_m: (>= 64 w,) and beam: (>= w,) of the window's w tiles, see `Crossed`.
    """
    column, row = _steps_to(shape[0], True, shape[1]), _steps_to(shape[1], False, shape[1])
    cells_x, cells_y = shape[0] * TILE_CELLS, shape[1] * TILE_CELLS
    first_x, first_y = corner[0] * TILE_CELLS, corner[1] * TILE_CELLS
    x, y = origin[0], origin[1]
    for b in range(len(free_m)):
        ux, uy = direction[b, 0], direction[b, 1]
        t, end = _within(x, ux, first_x * cell_m, (first_x + cells_x) * cell_m, 0.0, free_m[b])
        t, end = _within(y, uy, first_y * cell_m, (first_y + cells_y) * cell_m, t, end)
        if not t < end:
            continue
        ix = min(max(int(np.floor((x + t * ux) / cell_m)) - first_x, 0), cells_x - 1)
        iy = min(max(int(np.floor((y + t * uy) / cell_m)) - first_y, 0), cells_y - 1)
        sx, sy = (1 if ux > 0.0 else -1), (1 if uy > 0.0 else -1)
        next_x = ((first_x + ix + (ux > 0.0)) * cell_m - x) / ux if ux != 0.0 else np.inf
        next_y = ((first_y + iy + (uy > 0.0)) * cell_m - y) / uy if uy != 0.0 else np.inf
        step_x = cell_m / abs(ux) if ux != 0.0 else np.inf
        step_y = cell_m / abs(uy) if uy != 0.0 else np.inf
        ix, iy = ix + 1, iy + 1
        while t < end:
            leave = min(next_x, next_y, end)
            at = column[ix] + row[iy]
            length_m[at] += max(leave - t, 0.0)
            beam[at // TILE_AREA] = b
            t = leave
            x_first = next_x <= next_y
            ix += sx if x_first else 0
            iy += 0 if x_first else sy
            # sums that do not wait for the comparison
            next_x, next_y = (
                next_x + step_x if x_first else next_x,
                next_y if x_first else next_y + step_y,
            )


@compiled
def _within(
    at: float, u: float, low: float, high: float, t: float, end: float
) -> tuple[float, float]:
    """The part of [t, end] in which at + t u is within [low, high) (a slab)."""
    if u == 0.0:
        return (t, end) if low <= at < high else (t, t)
    a, b = (low - at) / u, (high - at) / u
    return max(t, min(a, b)), min(end, max(a, b))
