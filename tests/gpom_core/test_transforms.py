from math import cos, pi, sin

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from gpom_core.errors import InvalidTransformError
from gpom_core.transforms import (
    IDENTITY,
    compose,
    from_planar,
    interpolate,
    inverse,
    planar,
    rigid,
    rotate,
)

coordinates = st.floats(-1e3, 1e3)
parts = st.floats(-1.0, 1.0)


@st.composite
def poses(draw):
    turn = np.array([draw(parts) for _ in range(4)])
    length = np.linalg.norm(turn)
    turn = turn / length if length > 0.1 else np.array([0.0, 0.0, 0.0, 1.0])
    return rigid(*(draw(coordinates) for _ in range(3)), *turn)


def same(first, second, tolerance=1e-8) -> None:
    sign = np.sign(np.dot(first[3:], second[3:]))  # q and -q are one rotation
    assert first[:3] == pytest.approx(second[:3], abs=tolerance * 1e3)
    assert first[3:] == pytest.approx([sign * v for v in second[3:]], abs=tolerance)


@given(poses(), poses(), poses())
def test_composition_is_associative(a, b, c) -> None:
    same(compose(compose(a, b), c), compose(a, compose(b, c)))


@given(poses())
def test_inverse_undoes(pose) -> None:
    same(compose(pose, inverse(pose)), IDENTITY)
    same(compose(inverse(pose), pose), IDENTITY)


@given(poses(), poses(), st.tuples(coordinates, coordinates, coordinates))
def test_points_move_by_one_after_the_other(a, b, point) -> None:
    def move(pose, place):
        return np.array(pose[:3]) + rotate(pose, *place)

    assert move(compose(a, b), point) == pytest.approx(move(a, move(b, point)), abs=1e-6)


@given(poses(), poses())
def test_interpolation_ends_where_it_should_and_is_symmetric(a, b) -> None:
    same(interpolate(a, b, 0.0), a)
    same(interpolate(a, b, 1.0), b)
    if abs(np.dot(a[3:], b[3:])) > 0.01:  # of a half turn, either way round is as short
        same(interpolate(a, b, 0.3), interpolate(b, a, 0.7), 1e-6)


@given(st.floats(-3.0, 3.0), st.floats(-1.5, 1.5), st.floats(0.0, 1.0))
def test_on_the_floor_it_interpolates_the_heading(yaw, turn, fraction) -> None:
    way = interpolate(from_planar(1, 2, yaw), from_planar(3, 6, yaw + turn), fraction)
    seen = planar(way)
    assert (seen.x_m, seen.y_m) == pytest.approx((1 + 2 * fraction, 2 + 4 * fraction))
    expected = yaw + fraction * turn
    # Between nearly equal rotations a straight line is good to a few millionths.
    assert cos(seen.yaw_rad - expected) == pytest.approx(1.0, abs=1e-9)


def test_planar_tells_upside_down() -> None:
    hanging = rigid(0.0, 0.0, 1.0, 1.0, 0.0, 0.0, 0.0)  # rolled by half a turn
    assert planar(hanging) == pytest.approx((0.0, 0.0, 0.0, -1.0))
    leaning = rigid(0.0, 0.0, 0.0, 0.0, sin(pi / 6), 0.0, cos(pi / 6))
    assert planar(leaning).up == pytest.approx(0.5)


@pytest.mark.parametrize(
    "numbers",
    [
        (0, 0, 0, 0, 0, 0, 0),
        (0, 0, 0, 0, 0, 0, 2),
        (np.nan, 0, 0, 0, 0, 0, 1),
        (0, 0, np.inf, 0, 0, 0, 1),
    ],
)
def test_refuses_what_is_no_motion(numbers) -> None:
    with pytest.raises(InvalidTransformError):
        rigid(*numbers)
