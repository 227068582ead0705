from dataclasses import replace
from math import cos, pi, sin

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from gpom_core.errors import InvalidScanError
from gpom_core.sweep import Sweep, to_scan, to_still_scan
from gpom_core.transforms import compose, from_planar, interpolate, planar, rigid

HALF_M = 4.0
BEAMS = 360


def measured(first, last, beams=BEAMS) -> Sweep:
    """What a sensor in a square room sees while it goes from one pose to the other."""
    angle_min, step = -pi + 0.003, 2 * pi / beams
    ranges = []
    for index in range(beams):
        at = planar(interpolate(first, last, index / (beams - 1)))
        angle = at.yaw_rad + angle_min + step * index
        along = np.array([cos(angle), sin(angle)])
        with np.errstate(divide="ignore"):
            ranges.append(np.min((np.sign(along) * HALF_M - np.array(at[:2])) / along))
    return Sweep(
        frame="laser",
        stamp_ns=5,
        ranges_m=np.array(ranges, np.float32),
        angle_min_rad=angle_min,
        angle_increment_rad=step,
        range_min_m=0.05,
        range_max_m=30.0,
        time_increment_s=0.1 / beams,
        scan_time_s=0.1,
    )


def error_m(scan) -> float:
    """How far hits are from the walls, at worst but for the corners."""
    hits = scan.hits()
    angle, ranges = scan.beam_angles_rad()[hits], scan.ranges_m[hits]
    x = scan.pose.x_m + ranges * np.cos(angle)
    y = scan.pose.y_m + ranges * np.sin(angle)
    away = np.abs(np.maximum(np.abs(x), np.abs(y)) - HALF_M)
    return float(np.quantile(away, 0.98))


def test_a_robot_that_stands_still_is_left_alone() -> None:
    pose = from_planar(1.0, 0.5, 0.3)
    sweep = measured(pose, pose)
    scan = to_still_scan(sweep, pose, pose)
    assert scan.ranges_m is sweep.ranges_m or np.array_equal(scan.ranges_m, sweep.ranges_m)
    assert scan.pose == pytest.approx((1.0, 0.5, 0.3))
    assert error_m(scan) < 1e-4


@settings(max_examples=30)
@given(st.floats(-0.2, 0.2), st.floats(-0.2, 0.2), st.floats(-0.3, 0.3), st.floats(-3.0, 3.0))
def test_motion_within_a_sweep_is_taken_out(dx, dy, turn, yaw) -> None:
    first = from_planar(0.5, -0.4, yaw)
    last = from_planar(0.5 + dx, -0.4 + dy, yaw + turn)
    sweep = measured(first, last)
    still = error_m(to_still_scan(sweep, first, last))
    assert still < 0.004
    assert still <= error_m(to_scan(sweep, first)) + 0.002


def test_by_how_much_it_helps() -> None:
    first, last = from_planar(0.0, 0.0, 0.0), from_planar(0.15, 0.0, 0.15)  # 1.5 m/s, 1.5 rad/s
    sweep = measured(first, last)
    assert error_m(to_scan(sweep, first)) > 0.1
    assert error_m(to_still_scan(sweep, first, last)) < 0.002


def test_beams_without_echo_stay_what_they_are() -> None:
    first, last = from_planar(0.0, 0.0, 0.0), from_planar(0.1, 0.1, 0.1)
    sweep = measured(first, last)
    ranges = sweep.ranges_m.copy()
    ranges[50:60], ranges[100:110], ranges[200] = np.inf, np.nan, -np.inf
    scan = to_still_scan(replace(sweep, ranges_m=ranges), first, last)
    assert np.isposinf(scan.ranges_m[52:58]).all()
    assert np.isnan(scan.ranges_m[102:108]).all()
    assert error_m(scan) < 0.004


def test_a_sensor_that_hangs_upside_down_sees_the_same_room() -> None:
    upright = from_planar(1.0, 0.0, 0.5)
    hanging = compose(upright, rigid(0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0))
    sweep = measured(upright, upright)
    mirrored = replace(
        sweep,
        angle_min_rad=-sweep.angle_min_rad,
        angle_increment_rad=-sweep.angle_increment_rad,
    )
    assert error_m(to_scan(mirrored, hanging)) < 1e-4


def test_a_tilted_sensor_is_refused() -> None:
    sweep = measured(from_planar(0, 0, 0), from_planar(0, 0, 0))
    with pytest.raises(InvalidScanError, match="leans by 60 degrees") as caught:
        to_scan(sweep, rigid(0, 0, 0, sin(pi / 6), 0, 0, cos(pi / 6)))
    assert caught.value.reason == "tilted"


def test_a_turn_faster_than_the_sweep_is_refused() -> None:
    first, last = from_planar(0, 0, 0), from_planar(0, 0, -3.0)
    sweep = measured(first, last)
    narrow = replace(sweep, ranges_m=sweep.ranges_m[:90], angle_min_rad=-1.0)
    with pytest.raises(InvalidScanError) as caught:
        to_still_scan(narrow, first, last)
    assert caught.value.reason == "turned_too_fast"


def test_the_last_beam_is_timed_only_when_the_sensor_says_so() -> None:
    sweep = measured(from_planar(0, 0, 0), from_planar(0, 0, 0))
    assert sweep.last_stamp_ns - sweep.stamp_ns == round(0.1 / BEAMS * (BEAMS - 1) * 1e9)
    for strange in (0.0, -1e-4, 10.0, float("nan")):
        assert replace(sweep, time_increment_s=strange).last_stamp_ns == sweep.stamp_ns
