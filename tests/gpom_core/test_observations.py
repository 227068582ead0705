"""What an expert is trained on: the rows of its cluster, merged and weighed."""

import numpy as np
import pytest

from gpom_core.config import MapConfig
from gpom_core.evidence import Evidence
from gpom_core.observations import Observations, merge_areas
from gpom_core.rows import BOX, POINT, SEGMENT, cell_key
from tests.gpom_core.synthetic import look, points_observed, scan_of, tour

CELL_M, RATIO = 0.1, 3.0


def keys(cells: np.ndarray) -> np.ndarray:
    return np.array([cell_key(BOX, int(x), int(y)) for x, y in cells], np.int64)


def block(x: int, y: int, edge: int) -> np.ndarray:
    """Cells of a square, (edge², 2)."""
    return np.stack(np.meshgrid(np.arange(x, x + edge), np.arange(y, y + edge)), -1).reshape(-1, 2)


def merged(
    cells: np.ndarray,
    near: float = np.inf,
    *,
    levels: int = 3,
    count: float = 1.0,
    cap: float = 100.0,
) -> list[tuple[float, float, float, float]]:
    """Low corner, edge and count of the merged areas, in cells, in order."""
    n = len(cells)
    geometry, total, *_ = merge_areas(
        keys(cells),
        np.full(n, count),
        np.full(n, near),
        np.zeros(n, np.bool_),
        CELL_M,
        levels,
        RATIO,
        cap,
    )
    np.testing.assert_allclose(*(geometry[:, 1] - geometry[:, 0]).T, atol=1e-12)
    edge = geometry[:, 1, 0] - geometry[:, 0, 0]
    table = np.column_stack([geometry[:, 0], edge]) / CELL_M
    return sorted(zip(*np.round(table, 6).T.tolist(), total.tolist(), strict=True))


def test_four_by_four_by_four_open_cells_become_one_area() -> None:
    assert merged(block(0, 0, 8)) == [(0, 0, 8, 64)]
    assert merged(block(-8, 16, 8)) == [(-8, 16, 8, 64)]


def test_areas_grow_no_larger_than_the_levels_allow() -> None:
    assert merged(block(0, 0, 8), levels=0) == sorted((x, y, 1, 1) for x, y in block(0, 0, 8))
    assert merged(block(0, 0, 4), levels=1) == [
        (0, 0, 2, 4),
        (0, 2, 2, 4),
        (2, 0, 2, 4),
        (2, 2, 2, 4),
    ]
    assert merged(block(0, 0, 16), levels=3) == [
        (0, 0, 8, 64),
        (0, 8, 8, 64),
        (8, 0, 8, 64),
        (8, 8, 8, 64),
    ]


def test_squares_off_the_lattice_of_squares_do_not_merge() -> None:
    assert merged(block(1, 1, 2)) == [(1, 1, 1, 1), (1, 2, 1, 1), (2, 1, 1, 1), (2, 2, 1, 1)]


def test_a_square_with_a_hole_does_not_merge() -> None:
    assert merged(block(0, 0, 2)[:3]) == [(0, 0, 1, 1), (0, 1, 1, 1), (1, 0, 1, 1)]


@pytest.mark.parametrize(("near", "edge"), [(0.29, 1), (0.31, 2), (0.59, 2), (0.61, 4), (1.21, 8)])
def test_areas_are_coarse_only_far_from_surfaces(near: float, edge: int) -> None:
    areas = merged(block(0, 0, 8), near)
    assert {area[2] for area in areas} == {edge}


def test_the_weight_is_the_sum_of_the_capped_counts() -> None:
    geometry, total, capped, _ = merge_areas(
        keys(block(0, 0, 2)), np.array([1.0, 50.0, 500.0, 2.0]), np.full(4, np.inf),
        np.zeros(4, np.bool_), CELL_M, 1, RATIO, 100.0,
    )  # fmt: skip
    assert len(geometry) == 1
    assert total.tolist() == [553.0]
    assert capped.tolist() == [153.0]


def test_no_areas_are_no_areas() -> None:
    assert merged(np.empty((0, 2))) == []


def test_observations_are_in_the_order_of_their_places() -> None:
    a, b = Evidence(MapConfig()), Evidence(MapConfig())
    for evidence, first, second in [(a, 1.03, 1.53), (b, 1.53, 1.03)]:
        for x in (first, second):
            evidence.add(scan_of([3.03 - x, 3.04 - x], x, 0.02, first=0.01, step=0.02))
    one, other = (evidence.take(0)[1].observations() for evidence in (a, b))
    assert len(one) > 10
    assert set(one.kinds.tolist()) == {POINT, BOX}
    assert np.array_equal(one.kinds, other.kinds)
    assert np.array_equal(one.geometry[one.kinds == BOX], other.geometry[one.kinds == BOX])
    np.testing.assert_allclose(one.geometry, other.geometry, atol=1e-9)


def test_targets_noise_and_counts_follow_the_evidence() -> None:
    config = MapConfig(hit_cap=4.0, hit_noise_std=0.5, free_noise_std=2.0, coarse_levels=0)
    evidence = Evidence(config)
    for _ in range(6):
        evidence.add(scan_of([1.01], 0.01, 0.02, first=0.0, step=0.01))
    o = evidence.take(0)[1].observations()
    hit = o.kinds == POINT
    assert o.targets[hit].tolist() == [1.0]
    assert o.count[hit].tolist() == [6.0]
    assert o.noise_variance[hit].tolist() == [0.5**2 / 4.0]
    assert (o.targets[~hit] == -1.0).all()
    assert (o.kinds[~hit] == BOX).all()
    np.testing.assert_allclose(o.noise_variance[~hit], 2.0**2 / o.count[~hit])
    assert o.count[~hit].sum() == pytest.approx(6 * (1.01 - config.hit_margin_m) / config.cell_m)


def test_merging_keeps_the_free_area_and_its_count() -> None:
    # No place is so far from all surfaces that its tile is one row.
    fine = Evidence(MapConfig(near_surface_m=20.0, coarse_levels=0))
    coarse = Evidence(MapConfig(near_surface_m=20.0))
    for scan in tour(5):
        fine.add(scan)
        coarse.add(scan)
    smaller = 0
    for c in range(int(fine.clusters.size[0])):
        a, b = fine.take(c)[1].observations(), coarse.take(c)[1].observations()
        for of in (area_of, lambda o: float(o.count[o.kinds == BOX].sum())):
            assert of(a) == pytest.approx(of(b), rel=1e-9)
        smaller += len(a) - len(b)
    assert smaller > 100


def area_of(o: Observations) -> float:
    boxes = o.geometry[o.kinds == BOX]
    return float(np.prod(boxes[:, 1] - boxes[:, 0], axis=1).sum())


def test_segments_are_observations_too() -> None:
    evidence = Evidence(MapConfig(free_evidence="segments"))
    evidence.add(look(0.0, 0.0))
    kinds = np.concatenate(
        [evidence.take(c)[1].observations().kinds for c in range(int(evidence.clusters.size[0]))]
    )
    assert set(kinds.tolist()) == {POINT, SEGMENT}


@pytest.mark.parametrize("name", ["targets", "noise_variance", "count"])
def test_arrays_that_do_not_fit_together_are_refused(name: str) -> None:
    o = points_observed([[0.0, 0.0], [1.0, 0.0]], [1.0, -1.0])
    arrays = {n: getattr(o, n) for n in ("kinds", "geometry", "targets", "noise_variance", "count")}
    with pytest.raises(ValueError, match=rf"{name} has shape \(3,\), expected \(2,\)"):
        Observations(**arrays | {name: np.ones(3)})
    with pytest.raises(ValueError, match=r"geometry has shape .*, expected \(2, 2, d\)"):
        Observations(**arrays | {"geometry": o.geometry[:, 0]})
