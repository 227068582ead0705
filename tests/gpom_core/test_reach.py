"""Reach: each tile lists exactly the observations near it."""

import numpy as np
import pytest

from gpom_core.reach import reach_of, tile_key

TILE_M, CUTOFF_M = 0.5, 0.8


def distance_of_boxes(shape: np.ndarray, low: np.ndarray, high: np.ndarray) -> float:
    """Between the bounding box of a shape (2, 2) and a box."""
    apart = np.maximum(np.maximum(low - shape.max(axis=0), shape.min(axis=0) - high), 0.0)
    return float(np.hypot(*apart))


def random_shapes(n: int = 25) -> np.ndarray:
    rng = np.random.default_rng(0)
    start = rng.uniform(-3.0, 3.0, (n, 1, 2))
    return np.concatenate([start, start + rng.uniform(-1.0, 1.0, (n, 1, 2))], axis=1)


def listed(shapes: np.ndarray) -> dict[int, set[int]]:
    reach = reach_of(shapes, TILE_M, CUTOFF_M)
    assert (np.diff(reach.tiles) > 0).all()
    assert reach.starts[0] == 0
    assert reach.starts[-1] == len(reach.members)
    parts = np.split(reach.members, reach.starts[1:-1])
    return {int(key): set(p.tolist()) for key, p in zip(reach.tiles, parts, strict=True)}


def test_tiles_list_what_is_within_the_cut_off_and_nothing_else() -> None:
    shapes = random_shapes()
    tiles = listed(shapes)
    expected = {}
    for ix in range(-15, 15):
        for iy in range(-15, 15):
            low = TILE_M * np.array([ix, iy])
            near = {
                i
                for i, shape in enumerate(shapes)
                if distance_of_boxes(shape, low, low + TILE_M) < CUTOFF_M
            }
            if near:
                expected[int(tile_key(ix, iy))] = near
    assert tiles == expected


@pytest.mark.parametrize("shift", [(1e7, -1e7), (-3e6, 2.5e6)])
def test_reach_is_the_same_far_from_the_origin(shift: tuple[float, float]) -> None:
    shapes = np.round(random_shapes() * 256) / 256  # so that moving them rounds nothing
    here, there = listed(shapes), listed(shapes + np.array(shift))
    step = int(tile_key(int(shift[0] / TILE_M), int(shift[1] / TILE_M)) - tile_key(0, 0))
    assert {key + step: members for key, members in here.items()} == there


def test_no_observations_reach_nothing() -> None:
    reach = reach_of(np.empty((0, 2, 2)), TILE_M, CUTOFF_M)
    assert len(reach.tiles) == len(reach.members) == 0


def test_shapes_far_apart_are_listed_as_those_close_by() -> None:
    shapes = random_shapes()
    apart = shapes + np.where(np.arange(len(shapes)) < 12, 0.0, 4000.0)[:, None, None]
    near, far = listed(apart[:12]), listed(apart)
    assert {key: far[key] for key in near} == near
    assert len(far) > len(near)
