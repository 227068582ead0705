"""Sides: the kernel of a box from the error functions at its edges."""

import numpy as np
from scipy.special import erf

from gpom_core.kernels import cross
from gpom_core.rows import BOX, POINT
from gpom_core.sides import sides_of

LENGTH_SCALE_M = 0.2


def boxes(n: int = 40) -> np.ndarray:
    """Squares of one lattice at three levels."""
    rng = np.random.default_rng(0)
    edge = 0.1 * 2.0 ** rng.integers(0, 3, (n, 1))
    low = edge * rng.integers(-4, 5, (n, 2))
    return np.stack([low, low + edge], axis=1)


def test_a_box_is_the_product_of_differences_at_its_edges() -> None:
    geometry = boxes()
    kinds = np.full(len(geometry), BOX, np.uint8)
    points = np.random.default_rng(1).uniform(-1.0, 1.0, (30, 2))
    sides = sides_of(kinds, geometry, LENGTH_SCALE_M)
    at = points[:, :, None] * np.sqrt(0.5) / LENGTH_SCALE_M
    a, b, c, d = sides.edges[sides.corners.T]
    across = erf(at[:, 0] - a) - erf(at[:, 0] - b)
    up = erf(at[:, 1] - c) - erf(at[:, 1] - d)
    expected = cross(kinds, geometry, points, LENGTH_SCALE_M)
    assert abs(sides.factor * across * up - expected).max() < 1e-9


def test_boxes_of_one_lattice_share_edges() -> None:
    geometry = boxes()
    sides = sides_of(np.full(len(geometry), BOX, np.uint8), geometry, LENGTH_SCALE_M)
    distinct = sum(len(np.unique(geometry[:, :, axis].round(9))) for axis in (0, 1))
    assert distinct <= len(sides.edges) < 2 * distinct  # rounding may tell two of them apart


def test_what_is_no_box_has_no_sides() -> None:
    geometry = np.zeros((3, 2, 2))
    sides = sides_of(np.full(3, POINT, np.uint8), geometry, LENGTH_SCALE_M)
    assert len(sides.edges) == 0
    assert not sides.factor.any()


def test_a_box_without_width_is_finite() -> None:
    geometry = np.array([[(0.0, 0.0), (0.0, 0.1)]])
    sides = sides_of(np.full(1, BOX, np.uint8), geometry, LENGTH_SCALE_M)
    assert np.isfinite(sides.factor).all()
