"""Cutting a log into robots, and when each of their scans is due."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from clients.replay import Pace, cut, robot_names, schedule
from gpom_core.errors import ConfigurationError
from gpom_core.scan import Pose2D, Scan

SCAN = Scan(Pose2D(0.0, 0.0, 0.0), np.ones(2, np.float32), 0.0, 1.0, 0.1, 10.0)
EPOCH_NS = 1_071_078_718_462_369_000


def log(*seconds):
    return [replace(SCAN, stamp_ns=EPOCH_NS + round(s * 1e9)) for s in seconds]


def indices(trajectories):
    """Index of every scan in a log whose stamps are its indices."""
    return [[scan.stamp_ns for scan in scans] for scans in trajectories]


@given(st.integers(1, 60), st.integers(1, 12), st.booleans())
def test_cutting_keeps_every_scan_once_and_in_order(count, robots, skip):
    scans = [replace(SCAN, stamp_ns=i) for i in range(count)]
    kept = [i for i in range(count) if not (skip and i % 10 == 5)]
    if robots > len(kept):
        with pytest.raises(ConfigurationError, match="robots"):
            cut(scans, robots, skip_held_out=skip)
        return
    parts = indices(cut(scans, robots, skip_held_out=skip))
    assert [index for part in parts for index in part] == kept
    assert max(map(len, parts)) - min(map(len, parts)) <= 1


def test_scans_are_held_out_by_their_index_in_the_whole_log():
    scans = [replace(SCAN, stamp_ns=i) for i in range(24)]
    assert indices(cut(scans, 2, skip_held_out=True)) == [
        [0, 1, 2, 3, 4, 6, 7, 8, 9, 10, 11],
        [12, 13, 14, 16, 17, 18, 19, 20, 21, 22, 23],
    ]


def test_as_fast_as_possible_robots_take_turns():
    plan = schedule([log(0, 1, 2), log(5, 6)], Pace())
    assert [departure.robot for departure in plan] == [0, 1, 0, 1, 0]
    assert {departure.due_s for departure in plan} == {0.0}


def test_a_rate_holds_for_every_robot():
    plan = schedule([log(0, 9, 10), log(5, 6)], Pace(rate_hz=4.0))
    assert [(d.due_s, d.robot) for d in plan] == [(0, 0), (0, 1), (0.25, 0), (0.25, 1), (0.5, 0)]


def test_recorded_times_start_with_each_robot_and_scale():
    plan = schedule([log(10, 12, 13.5), log(40, 41)], Pace(speed=2.0))
    assert [(round(d.due_s, 6), d.robot) for d in plan] == [
        (0.0, 0),
        (0.0, 1),
        (0.5, 1),
        (1.0, 0),
        (1.75, 0),
    ]


def test_a_clock_set_back_delays_nothing():
    assert Pace(speed=1.0).due_s(log(10, 12, 11, 12.5)) == [0.0, 2.0, 2.0, 2.5]


@pytest.mark.parametrize("value", [0.0, -1.0, float("nan"), float("inf")])
@pytest.mark.parametrize("name", ["rate_hz", "speed"])
def test_refuses_impossible_paces(name, value):
    with pytest.raises(ConfigurationError, match=name):
        Pace(**{name: value})


def test_refuses_two_paces():
    with pytest.raises(ConfigurationError, match="one of them"):
        Pace(rate_hz=1.0, speed=1.0)


def test_names_of_robots():
    assert robot_names("r", 1) == ["r"]
    assert robot_names("r", 3) == ["r-1", "r-2", "r-3"]
