"""The grids: exact traversal, one vote per scan, blending, clamping, growth."""

from math import floor

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from gpom_core.baselines import (
    CountingGrid,
    CountingModel,
    LogOddsGrid,
    LogOddsModel,
    OccupancyGrid,
    best_by_likelihood,
)
from gpom_core.errors import ConfigurationError, InvalidQueryError

GRIDS = [CountingGrid, LogOddsGrid]
coordinate = st.floats(-6.0, 6.0) | st.integers(-12, 12).map(lambda v: v / 2)


def centres(*cells: tuple[int, int]) -> np.ndarray:
    return np.array(cells) + 0.5


def cells_of(grid: OccupancyGrid) -> set[tuple[int, int]]:
    return {(floor(x), floor(y)) for x, y in grid.seen_cells() / grid.resolution_m}


def meets(cell: tuple[int, int], a: np.ndarray, b: np.ndarray, margin: float) -> bool:
    """Whether the segment meets the cell grown by a margin (slab test)."""
    enter, leave = 0.0, 1.0
    for low, start, step in zip(cell, a, b - a, strict=True):
        sides = np.array([low - margin, low + 1 + margin])
        if abs(step) < 1e-300:  # 1 / step would overflow
            if not sides[0] <= start <= sides[1]:
                return False
            continue
        first, last = np.sort((sides - start) / step)
        enter, leave = max(enter, first), min(leave, last)
    return enter <= leave


@given(coordinate, coordinate, coordinate, coordinate)
def test_a_beam_touches_exactly_the_cells_it_crosses(
    ax: float, ay: float, bx: float, by: float
) -> None:
    a, b = np.array([ax, ay]), np.array([bx, by])
    grid = CountingGrid(1.0)
    grid.add(a, b[None])
    seen = cells_of(grid)
    around = {(i, j) for i in range(-8, 8) for j in range(-8, 8)}
    # corners touched to within rounding may go either way
    assert {c for c in around if meets(c, a, b, -1e-9)} <= seen
    assert seen <= {c for c in around if meets(c, a, b, 1e-9)}


@pytest.mark.parametrize("scale", [1.0, 0.05])
@pytest.mark.parametrize(
    ("end", "expected"),
    [
        ((3.5, 0.5), {(0, 0), (1, 0), (2, 0), (3, 0)}),
        ((-1.5, 0.5), {(0, 0), (-1, 0), (-2, 0)}),
        ((0.5, -2.5), {(0, 0), (0, -1), (0, -2), (0, -3)}),
        ((2.6, 1.4), {(0, 0), (1, 0), (1, 1), (2, 1)}),
        ((0.6, 0.6), {(0, 0)}),
    ],
)
def test_beams_by_hand(
    end: tuple[float, float], expected: set[tuple[int, int]], scale: float
) -> None:
    grid = CountingGrid(scale)
    grid.add(np.array([0.5, 0.5]) * scale, np.array([end]) * scale)
    assert cells_of(grid) == expected


def test_a_cell_counts_once_per_scan_and_a_hit_beats_a_miss() -> None:
    grid = CountingGrid(1.0)
    fan = np.array([[2.5, 0.5], [2.6, 0.5], [4.5, 0.5]])  # the third passes the first two's cell
    for _ in range(3):
        grid.add(np.array([0.5, 0.5]), fan)
    hits, misses = grid.counts(centres((0, 0), (1, 0), (2, 0), (3, 0), (4, 0), (5, 0)))
    assert hits.tolist() == [0, 0, 3, 0, 3, 0]
    assert misses.tolist() == [3, 3, 0, 3, 0, 0]


def test_counting_formula_and_bilinear_blend() -> None:
    grid = CountingGrid(1.0, CountingModel(hit_weight=20.0, prior_count=0.05))
    grid.add(np.array([0.5, 0.5]), np.array([[2.5, 0.5]]))
    points = np.array([[1.5, 0.5], [2.5, 0.5], [1.75, 0.5], [1.75, 0.75], [9.0, 9.0]])
    p, known = grid.occupancy(points)
    share = np.array([0.0, 1.0, 0.25, 0.25, 0.0])  # of the hit cell, along x
    height = np.array([1.0, 1.0, 1.0, 0.75, 0.0])  # of the row, along y
    h, m = share * height, (1 - share) * height
    assert p == pytest.approx((20 * h + 0.05) / (20 * h + m + 0.1))
    assert known.tolist() == [True, True, True, True, False]
    assert p[-1] == 0.5


def test_weights_can_be_changed_on_the_same_counts() -> None:
    grid = CountingGrid(1.0)
    grid.add(np.array([0.5, 0.5]), np.array([[2.5, 0.5]]))
    other = grid.with_model(CountingModel(hit_weight=1.0, prior_count=1.0))
    assert other.occupancy(centres((2, 0)))[0] == pytest.approx(2 / 3)
    assert grid.model == CountingModel()


def test_log_odds_add_up_and_are_clamped() -> None:
    grid = LogOddsGrid(1.0, LogOddsModel())
    points = np.array([[1.1, 0.9], [2.9, 0.1], [7.0, 7.0]])  # anywhere in the cell
    grid.add(np.array([0.5, 0.5]), np.array([[2.5, 0.5]]))
    p, known = grid.occupancy(points)
    assert p == pytest.approx([0.4, 0.7, 0.5])
    assert known.tolist() == [True, True, False]
    grid.add(np.array([0.5, 0.5]), np.array([[2.5, 0.5]]))
    assert grid.occupancy(points)[0][:2] == pytest.approx([4 / 13, 49 / 58])
    for _ in range(50):
        grid.add(np.array([0.5, 0.5]), np.array([[2.5, 0.5]]))
    assert grid.occupancy(points)[0] == pytest.approx([0.12, 0.97, 0.5])


@pytest.mark.parametrize("kind", GRIDS)
def test_growth_keeps_what_was_seen(kind: type[OccupancyGrid]) -> None:
    rng = np.random.default_rng(2)
    scans = [(rng.uniform(-40, 40, 2), rng.uniform(-40, 40, (30, 2))) for _ in range(12)]
    grown, roomy = kind(0.25), kind(0.25)
    roomy.add(np.array([60.0, 60.0]), np.array([[60.1, 60.1]]))
    roomy.add(np.array([-60.0, -60.0]), np.array([[-60.1, -60.1]]))
    for origin, hits in scans:
        grown.add(origin, hits)
        roomy.add(origin, hits)
    points = rng.uniform(-45, 45, (2000, 2))
    for got, expected in zip(grown.occupancy(points), roomy.occupancy(points), strict=True):
        assert np.array_equal(got, expected)


@pytest.mark.parametrize("kind", GRIDS)
@given(st.integers(-40_000_000, 40_000_000), st.integers(-40_000_000, 40_000_000))
def test_the_map_moves_with_the_frame(kind: type[OccupancyGrid], i: int, j: int) -> None:
    origin, hits = np.array([0.3, 0.2]), np.array([[4.3, 2.6], [-3.2, 1.1], [0.7, -5.3]])
    points = np.array([[2.2, 1.3], [4.3, 2.6], [0.6, -3.1], [8.0, 8.0]])
    here, there = kind(0.25), kind(0.25)
    shift = np.array([i, j]) * 0.25
    here.add(origin, hits)
    there.add(origin + shift, hits + shift)
    assert there.occupancy(points + shift)[0] == pytest.approx(here.occupancy(points)[0], abs=1e-4)


@pytest.mark.parametrize("kind", GRIDS)
def test_an_empty_grid_knows_nothing(kind: type[OccupancyGrid]) -> None:
    grid = kind(0.1)
    grid.add(np.zeros(2), np.empty((0, 2)))
    p, known = grid.occupancy(np.array([[0.0, 0.0], [1e6, -1e6]]))
    assert p.tolist() == [0.5, 0.5]
    assert not known.any()
    assert grid.seen_cells().shape == (0, 2)


@pytest.mark.parametrize("kind", GRIDS)
def test_bad_input_is_refused_and_changes_nothing(kind: type[OccupancyGrid]) -> None:
    with pytest.raises(ConfigurationError, match="resolution_m"):
        kind(0.0)
    grid = kind(0.05)
    grid.add(np.zeros(2), np.array([[1.0, 1.0]]))
    seen = grid.seen_cells()
    with pytest.raises(InvalidQueryError, match="finite"):
        grid.add(np.array([np.nan, 0.0]), np.array([[1.0, 1.0]]))
    with pytest.raises(ConfigurationError, match="coarser"):
        grid.add(np.zeros(2), np.array([[1e5, 1e5]]))
    assert np.array_equal(grid.seen_cells(), seen)


def test_the_best_grid_has_the_lowest_likelihood_loss() -> None:
    grids = [CountingGrid(0.05), CountingGrid(1.0)]
    wall = np.column_stack([np.full(40, 2.03), np.linspace(-0.5, 0.5, 40)])
    for grid in grids:
        grid.add(np.zeros(2), wall)
    points = np.concatenate([wall, wall * 0.8])
    occupied = np.arange(len(points)) < len(wall)
    assert best_by_likelihood(grids, points, occupied) is grids[0]
    assert best_by_likelihood(grids[::-1], points, occupied) is grids[0]
