"""Line tracking: where runs of hits begin and end."""

import numpy as np
import pytest

from gpom_core.lines import moments_of, principal_axis, track_lines

TOLERANCE_M, GAP_M = 0.1, 0.3
SPACING_M = 0.05


def along(start: tuple[float, float], end: tuple[float, float], n: int = 41) -> np.ndarray:
    return np.linspace(start, end, n)


def runs(xy: np.ndarray, spacing_m: float = SPACING_M) -> list[int]:
    """Lengths of the runs."""
    starts = track_lines(xy, np.full(len(xy), spacing_m), TOLERANCE_M, GAP_M)
    assert starts.shape == (len(xy) + 1,)
    assert starts[-1] == len(xy)
    lengths = np.diff(starts)
    count = np.count_nonzero(lengths)
    assert (lengths[:count] > 0).all()  # all runs come first, then the padding
    return lengths[:count].tolist()


def test_a_straight_wall_is_one_run() -> None:
    assert runs(along((1.0, -1.0), (1.0, 1.0))) == [41]


@pytest.mark.parametrize("turn_rad", [0.5, 1.57, 2.5])
def test_a_corner_makes_two_runs_and_is_where_they_meet(turn_rad: float) -> None:
    there = along((-2.0, 1.0), (0.0, 1.0))
    on = 2.0 * np.linspace(0.0, 1.0, 41)[1:, None] * (np.cos(turn_rad), np.sin(turn_rad))
    lengths = runs(np.concatenate([there, on + np.array([0.0, 1.0])]))
    assert len(lengths) == 2
    # The turn is noticed once it has left the line by the tolerance.
    assert 0 <= lengths[0] - 41 <= np.ceil(TOLERANCE_M / np.sin(turn_rad) / 0.05) + 1


def test_a_gap_makes_two_runs() -> None:
    xy = np.concatenate([along((-2.0, 1.0), (-0.5, 1.0), 31), along((0.0, 1.0), (1.5, 1.0), 31)])
    assert runs(xy) == [31, 31]


def test_a_gap_that_the_scanner_cannot_help_is_none() -> None:
    xy = along((-2.0, 1.0), (2.0, 1.0), 9)  # 0.5 m from hit to hit
    assert runs(xy, spacing_m=0.2) == [9]
    assert runs(xy, spacing_m=0.1) == [1] * 9


def test_noise_within_the_tolerance_does_not_break_a_run() -> None:
    xy = along((-2.0, 1.0), (2.0, 1.5), 81)
    xy += np.random.default_rng(0).normal(scale=0.2 * TOLERANCE_M, size=xy.shape)
    assert runs(xy) == [81]


def test_a_step_in_a_wall_makes_two_runs() -> None:
    xy = along((-2.0, 1.0), (2.0, 1.0), 81)
    xy[40:, 1] += 2.0 * TOLERANCE_M
    assert runs(xy) == [40, 41]


def test_runs_do_not_depend_on_which_way_the_scanner_turns() -> None:
    xy = np.concatenate([along((-2.0, 1.0), (-0.5, 1.0), 31), along((0.0, 1.0), (1.5, 1.0), 21)])
    assert runs(xy) == runs(xy[::-1])[::-1]


def test_runs_are_the_same_far_from_the_origin() -> None:
    rng = np.random.default_rng(1)
    wall = along((-2.0, 1.0), (0.0, 1.0)) + rng.normal(scale=0.02, size=(41, 2))
    other = along((0.0, 1.0), (0.0, 3.0)) + rng.normal(scale=0.02, size=(41, 2))
    xy = np.concatenate([wall, other])
    assert runs(xy) == runs(xy + np.array([1e6, -3e6]))


def test_no_hits_and_single_hits_are_runs_too() -> None:
    assert runs(np.empty((0, 2))) == []
    assert runs(np.array([[3.0, 4.0]])) == [1]
    assert runs(np.array([[3.0, 4.0], [-3.0, 4.0]])) == [1, 1]
    assert runs(np.array([[3.0, 4.0]] * 5)) == [5]


@pytest.mark.parametrize("angle_rad", [0.0, 0.3, 1.2, np.pi / 2, 2.5])
def test_the_principal_axis_is_the_first_eigenvector(angle_rad: float) -> None:
    rng = np.random.default_rng(2)
    turn = np.array(
        [[np.cos(angle_rad), -np.sin(angle_rad)], [np.sin(angle_rad), np.cos(angle_rad)]]
    )
    xy = (rng.normal(size=(500, 2)) * (2.0, 0.3)) @ turn.T + (1.0, -2.0)
    m = np.zeros(6)
    moments_of(xy[:200], m)
    moments_of(xy[200:], m)
    cx, cy, tx, ty, long, across = principal_axis(m)
    values, vectors = np.linalg.eigh(np.cov(xy.T, bias=True))
    np.testing.assert_allclose((cx, cy), xy.mean(axis=0))
    np.testing.assert_allclose((across, long), values, rtol=1e-9)
    assert abs(np.dot((tx, ty), vectors[:, 1])) == pytest.approx(1.0)


def test_a_single_point_has_an_axis_without_length() -> None:
    m = np.zeros(6)
    moments_of(np.array([[2.0, 3.0]]), m)
    *centre, tx, ty, long, across = principal_axis(m)
    assert centre == [2.0, 3.0]
    assert (long, across) == (0.0, 0.0)
    assert np.hypot(tx, ty) == pytest.approx(1.0)
