"""Beams count the length that they go through each cell, whatever window is looked at."""

import numpy as np
import pytest

from gpom_core.rows import NONE
from gpom_core.tiles import TILE_AREA, TILE_CELLS
from gpom_core.walk import WINDOW_TILES, Crossed, crossed_in, span, walk, window_room

CELL_M = 0.1
Beams = tuple[np.ndarray, np.ndarray, np.ndarray]


def star(seed: int, beams: int = 60, reach_m: float = 9.0) -> Beams:
    """A sensor, directions all around and along the axes, and lengths of which some are none."""
    rng = np.random.default_rng(seed)
    angle = np.append(rng.uniform(-np.pi, np.pi, beams), np.arange(4) * np.pi / 2)
    direction = np.column_stack([np.cos(angle), np.sin(angle)])
    direction[-4:] = np.round(direction[-4:])
    return rng.uniform(-5.0, 5.0, 2), direction, rng.uniform(-0.5, reach_m, beams + 4)


def cells(crossed: Crossed) -> dict[tuple[int, int], float]:
    """Length by cell of the lattice."""
    out = {}
    for w, place in zip(*np.nonzero(crossed.length_m), strict=True):
        tx, ty = crossed.corner[0] + w // crossed.breadth, crossed.corner[1] + w % crossed.breadth
        cell = (tx * TILE_CELLS + place // TILE_CELLS, ty * TILE_CELLS + place % TILE_CELLS)
        out[tuple(map(int, cell))] = float(crossed.length_m[w, place])
    return out


def walked(beams: Beams, corner: tuple[int, int], shape: tuple[int, int]) -> Crossed:
    tiles = shape[0] * shape[1]
    room = np.zeros((tiles + 3) * TILE_AREA), np.full(tiles + 3, NONE, np.int32)
    walk(*beams, corner, shape, CELL_M, *room)
    return crossed_in(corner, shape, *room)


def whole(beams: Beams) -> Crossed:
    tx, ty, nx, ny = span(*beams, CELL_M)
    return walked(beams, (tx, ty), (nx, ny))


@pytest.mark.parametrize("seed", range(5))
def test_all_free_length_is_in_the_window_that_beams_span(seed: int) -> None:
    beams = star(seed)
    assert whole(beams).length_m.sum() == pytest.approx(beams[2].clip(0.0).sum(), rel=1e-12)


def test_each_cell_has_the_length_of_all_beams_in_it() -> None:
    origin, direction, free_m = beams = star(7, beams=12, reach_m=3.0)
    steps = 20_000
    expected: dict[tuple[int, int], float] = {}
    for u, length in zip(direction, free_m.clip(0.0), strict=True):
        at = origin + ((np.arange(steps) + 0.5) * length / steps)[:, None] * u
        for cell, n in zip(
            *np.unique(np.floor(at / CELL_M).astype(int), axis=0, return_counts=True), strict=True
        ):
            key = (int(cell[0]), int(cell[1]))
            expected[key] = expected.get(key, 0.0) + n * length / steps
    got = cells(whole(beams))
    for cell in got.keys() | expected.keys():
        assert got.get(cell, 0.0) == pytest.approx(expected.get(cell, 0.0), abs=2e-3)


@pytest.mark.parametrize("seed", range(5))
def test_windows_side_by_side_see_what_one_window_sees(seed: int) -> None:
    beams = star(seed)
    tx, ty, nx, ny = span(*beams, CELL_M)
    together: dict[tuple[int, int], float] = {}
    for x in range(0, nx, 3):
        for y in range(0, ny, 5):
            shape = (min(3, nx - x), min(5, ny - y))
            part = cells(walked(beams, (tx + x, ty + y), shape))
            assert not part.keys() & together.keys()
            together |= part
    expected = cells(whole(beams))
    for cell in expected.keys() | together.keys():
        assert together.get(cell, 0.0) == pytest.approx(expected.get(cell, 0.0), abs=1e-9)


@pytest.mark.parametrize("seed", range(3))
def test_a_tile_knows_the_last_beam_that_went_through(seed: int) -> None:
    origin, direction, free_m = beams = star(seed)
    crossed = whole(beams)
    alone = [
        walked((origin, direction[b : b + 1], free_m[b : b + 1]), crossed.corner,
               (len(crossed.beam) // crossed.breadth, crossed.breadth))
        for b in range(len(free_m))
    ]  # fmt: skip
    for w, beam in enumerate(crossed.beam):
        through = [b for b, own in enumerate(alone) if own.beam[w] == 0]
        assert beam == (through[-1] if through else -1)


def test_no_free_beams_span_nothing() -> None:
    origin, direction, free_m = star(0)
    assert span(origin, direction, -abs(free_m), CELL_M) == (0, 0, 0, 0)


@pytest.mark.parametrize("shape", [(0, 0), (3, 5), (WINDOW_TILES, 1), (1000, 7), (500, 600)])
def test_there_is_room_for_the_largest_window(shape: tuple[int, int]) -> None:
    windows = [
        min(shape[0] - x, WINDOW_TILES) * min(shape[1] - y, WINDOW_TILES)
        for x in range(0, shape[0], WINDOW_TILES)
        for y in range(0, shape[1], WINDOW_TILES)
    ]
    assert window_room(shape) == max(windows, default=0)
