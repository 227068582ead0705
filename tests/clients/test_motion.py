"""How simulated robots move."""

import itertools
from math import pi

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from clients.motion import CORNER_CUT_M, drive, round_corners

polylines = st.lists(
    st.tuples(st.integers(0, 8), st.integers(0, 8)), min_size=2, max_size=8
).filter(lambda corners: all(a != b for a, b in itertools.pairwise(corners)))


def off_the_polyline(points, corners):
    distances = []
    for a, b in itertools.pairwise(corners):
        share = np.clip((points - a) @ (b - a) / ((b - a) @ (b - a)), 0.0, 1.0)
        distances.append(np.linalg.norm(points - (a + share[:, None] * (b - a)), axis=1))
    return np.min(distances, axis=0)


@given(polylines)
def test_rounded_paths_stay_near_the_corners_they_round(corners):
    corners = np.array(corners, dtype=float)
    path = round_corners(corners)
    assert off_the_polyline(path, corners).max() <= CORNER_CUT_M / 2 + 1e-9
    np.testing.assert_allclose(path[[0, -1]], corners[[0, -1]])
    steps = np.linalg.norm(np.diff(path, axis=0), axis=1)
    assert steps.min() > 0.0
    assert steps.max() <= 0.03 + 1e-9


@given(polylines, st.floats(-20.0, 20.0))
def test_speed_and_turn_rate_are_kept(corners, start_yaw):
    path = round_corners(np.array(corners, dtype=float))
    way = drive(path, speed_m_s=0.8, turn_rate_rad_s=1.5, start_yaw_rad=start_yaw)
    durations = np.diff(way.times_s)
    assert durations.min() >= 0.0
    assert (np.abs(np.diff(way.yaws_rad)) <= 1.5 * durations + 1e-9).all()
    steps = np.linalg.norm(np.diff(way.xy_m, axis=0), axis=1)
    assert (steps <= 0.8 * durations + 1e-9).all()
    assert way.pose(0.0) == (*path[0], start_yaw)
    np.testing.assert_allclose(way.pose(way.duration_s + 1.0)[:2], path[-1])


def test_a_reversal_is_turned_on_the_spot():
    path = round_corners(np.array([[0.0, 0.0], [2.0, 0.0], [0.0, 0.0]]))
    way = drive(path, speed_m_s=1.0, turn_rate_rad_s=1.0)
    assert way.duration_s == pytest.approx(4.0 + pi)
    middle = way.pose(2.0 + pi / 2)
    np.testing.assert_allclose(middle, (2.0, 0.0, pi / 2), atol=1e-9)


def test_robots_look_where_they_drive():
    way = drive(
        round_corners(np.array([[0.0, 0.0], [3.0, 0.0], [3.0, 3.0]])),
        speed_m_s=1.0,
        turn_rate_rad_s=2.0,
    )
    assert way.pose(0.1).yaw_rad == 0.0
    assert abs(way.pose(way.duration_s - 0.1).yaw_rad - pi / 2) < 1e-6
