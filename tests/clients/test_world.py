"""Laws of the simulated geometry: fast rays and distances against slow, obvious ones."""

from math import inf, nan, pi

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from clients.world import Box, World
from gpom_core.errors import ConfigurationError, InvalidQueryError

coordinate = st.floats(-5.0, 5.0)
size = st.floats(0.1, 3.0)
boxes = st.lists(
    st.builds(Box, coordinate, coordinate, size, size, st.floats(-4.0, 4.0)),
    min_size=1,
    max_size=6,
)


def first_crossing(world, origin, angle):
    """Nearest crossing of one ray with any side, one at a time."""
    direction = np.array([np.cos(angle), np.sin(angle)])
    nearest = inf
    for a, b in world.segments():
        matrix = np.column_stack([direction, a - b])
        if abs(np.linalg.det(matrix)) < 1e-9:
            continue
        along, share = np.linalg.solve(matrix, a - origin)
        if along >= 0.0 and 0.0 <= share <= 1.0:
            nearest = min(nearest, along)
    return nearest


@given(boxes, coordinate, coordinate, st.lists(st.floats(-pi, pi), min_size=1, max_size=5))
def test_rays_end_at_the_first_side_they_cross(solid, x, y, angles):
    world = World(solid)
    if world.is_occupied([[x, y]])[0]:
        np.testing.assert_array_equal(world.cast((x, y), np.array(angles)), 0.0)
        return
    for angle, found in zip(angles, world.cast((x, y), np.array(angles)), strict=True):
        expected = first_crossing(world, np.array([x, y]), angle)
        if np.isinf(expected) or np.isinf(found):
            # A ray along a corner: either answer is right, if it truly only grazes.
            finite = min(expected, found)
            if np.isfinite(finite):
                end = np.array([[x + finite * np.cos(angle), y + finite * np.sin(angle)]])
                assert abs(world.distance(end)[0]) < 1e-6
        elif abs(expected - found) > 1e-6:
            nearer = min(expected, found)
            end = np.array([[x + nearer * np.cos(angle), y + nearer * np.sin(angle)]])
            assert abs(world.distance(end)[0]) < 1e-6


@given(boxes, coordinate, coordinate)
def test_no_ray_is_shorter_than_the_distance(solid, x, y):
    world = World(solid)
    distance = world.distance([[x, y]])[0]
    assert world.cast((x, y), np.linspace(-pi, pi, 64)).min() >= max(distance, 0.0) - 1e-9


def test_distance_and_occupancy_of_a_turned_box():
    world = World([Box(1.0, 2.0, 2.0, 1.0, pi / 2)])
    points = [[1.0, 2.0], [1.0, 3.5], [2.5, 2.0], [1.5, 3.0], [2.5, 4.0]]
    np.testing.assert_allclose(world.distance(points), [-0.5, 0.5, 1.0, 0.0, np.hypot(1, 1)])
    np.testing.assert_array_equal(world.is_occupied(points[:3]), [True, False, False])
    assert world.bounds_m == pytest.approx((0.5, 1.0, 1.5, 3.0))
    assert world.segments().shape == (4, 2, 2)


def test_rays_along_the_axes_are_exact():
    world = World([Box(5.0, 0.0, 2.0, 2.0)])
    np.testing.assert_allclose(
        world.cast((0.0, 0.0), np.array([0.0, pi / 2, pi, -pi / 2])), [4.0, inf, inf, inf]
    )
    np.testing.assert_allclose(world.cast((0.0, 0.999), [0.0]), [4.0])


def test_no_points_have_no_distances():
    assert World([Box(0, 0, 1, 1)]).distance(np.empty((0, 2))).shape == (0,)


@pytest.mark.parametrize("points", [[1.0, 2.0], [[1.0, 2.0, 3.0]]])
def test_refuses_points_of_another_shape(points):
    with pytest.raises(InvalidQueryError, match=r"\(N, 2\)"):
        World([Box(0, 0, 1, 1)]).distance(points)


@pytest.mark.parametrize("solid", [[], [Box(0, 0, 0, 1)], [Box(0, nan, 1, 1)], [Box(0, 0, 1, inf)]])
def test_refuses_what_is_no_box(solid):
    with pytest.raises(ConfigurationError, match="box"):
        World(solid)
