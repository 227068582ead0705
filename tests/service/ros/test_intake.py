from math import pi

import numpy as np
import pytest

from gpom_core.ros.keys import Origin
from tests.gpom_core.ros.samples import S, cdr, laser_scan, odometry, pose, tf
from tests.gpom_core.ros.vectors import SCAN_LITTLE
from tests.service.ros.rig import NOBODY, WHOLE, Rig


def test_a_scan_stands_where_its_transforms_say() -> None:
    rig = Rig()
    rig.mount()
    rig.drive()
    rig.scan(round(2.5 * S))
    assert rig.scans[0][:2] == ("r1", "scan")
    (scan,) = rig.decoded()
    assert scan.pose == pytest.approx((3.0, 0.0, 0.0))
    assert (scan.stamp_ns, scan.seq, scan.reliable) == (round(2.5 * S), 1, False)
    status = rig.status()
    assert (status.received, status.waiting, status.delayed, status.problem) == (1, 0, 0, None)


def test_scans_before_their_transforms_wait_and_keep_their_order() -> None:
    rig = Rig()
    for tenth in range(1, 20):
        rig.scan(tenth * S // 10)
    assert rig.status().waiting == 19
    rig.mount()
    rig.drive(0, 1)
    assert [scan.stamp_ns for scan in rig.decoded()] == [n * S // 10 for n in range(1, 11)]
    rig.drive(2, 2)
    assert [scan.seq for scan in rig.decoded()] == list(range(1, 20))
    assert rig.status().delayed == 19
    assert not rig.status().dropped


def test_waiting_ends_and_says_why() -> None:
    rig = Rig(wait_s=2.0)
    rig.drive()
    rig.scan(S)
    rig.clock.advance(1.0)
    rig.intake.tick()
    words = "no transform from map to laser: no frame is called laser, since 2001-09-09T01:46:41Z"
    assert rig.status().problem == words
    assert rig.status().waiting == 1
    rig.clock.advance(1.5)
    rig.intake.tick()
    assert rig.status().dropped == {"no_transform": 1}
    assert rig.status().problem == words  # since it began
    rig.mount()
    rig.scan(2 * S)
    assert rig.status().problem is None
    assert [scan.seq for scan in rig.decoded()] == [1]  # dropped here is not lost on the way


def test_what_came_too_late_is_dropped_at_once() -> None:
    rig = Rig()
    rig.mount()
    rig.drive(5, 8)
    rig.scan(S)
    assert rig.status().dropped == {"late": 1}
    assert "known only from 4.000 s after the scan" in rig.status().problem


def test_so_many_wait_and_no_more() -> None:
    rig = Rig(waiting_max=3)
    for second in range(1, 6):
        rig.scan(second * S)
    assert rig.status().waiting == 3
    assert rig.status().dropped == {"waiting_full": 2}
    rig.mount()
    rig.drive()
    assert [scan.stamp_ns // S for scan in rig.decoded()] == [3, 4, 5]


def test_gaps_are_told_and_repetitions_left_out() -> None:
    rig = Rig()
    rig.mount()
    rig.drive()
    for number in (7, 8, 8, 11):
        rig.scan(number * S // 2, number=number)
    assert [scan.seq for scan in rig.decoded()] == [1, 2, 5]
    assert rig.status().dropped == {"repeated": 1}
    first = rig.decoded()[0].boot
    rig.scan(6 * S, gid=b"h" * 16, number=1)  # started anew
    assert rig.decoded()[-1].seq == 1
    assert rig.decoded()[-1].boot > first


def test_a_bridge_numbers_nothing() -> None:
    rig = Rig()
    rig.mount()
    rig.drive()
    for _ in range(3):
        rig.say("scan", laser_scan(S, "laser", **WHOLE))
    assert [scan.seq for scan in rig.decoded()] == [1, 2, 3]


def test_robots_have_frames_of_their_own_and_share_those_of_all() -> None:
    rig = Rig()
    rig.say("tf_static", tf(("map", "odom", (100, 0, 0), 0)), NOBODY)
    for name, x in (("r1", 1.0), ("r2", 2.0)):
        rig.say("tf_static", tf(("odom", "laser", (x, 0, 0), 0)), Origin(name, None))
        rig.scan(S, Origin(name, "front"), gid=name.encode() * 8)
    assert [(robot, sensor) for robot, sensor, _ in rig.scans] == [("r1", "front"), ("r2", "front")]
    assert [scan.pose.x_m for scan in rig.decoded()] == [101.0, 102.0]


def test_one_robot_without_a_namespace_has_the_name_of_the_settings() -> None:
    rig = Rig(robot="lonely")
    rig.scan(S, NOBODY)
    rig.mount(NOBODY)
    rig.drive(origin=NOBODY)
    assert rig.scans[0][0] == "lonely"
    assert rig.status("lonely").delayed == 1


@pytest.mark.parametrize(
    ("payload", "reason"),
    [
        (SCAN_LITTLE[:60], "bad_cdr"),
        (b"\x00\x07" + SCAN_LITTLE[2:], "unsupported_encoding"),
        (b"", "truncated"),
        (cdr(laser_scan(S, ranges=np.ones(1001))), "too_many_beams"),
    ],
)
def test_bad_scans_are_counted_by_reason(payload, reason) -> None:
    rig = Rig()
    rig.say("scan", payload)
    assert rig.status().dropped == {reason: 1}
    assert rig.status().problem


def test_bad_attachments_transforms_and_scans_without_meaning() -> None:
    rig = Rig()
    rig.say("scan", laser_scan(S), beside=b"?")
    rig.say("tf", tf(("map", "base", (np.nan, 0, 0), 0)))
    rig.mount()
    rig.drive()
    rig.scan(S, range_max=-1.0)
    assert rig.status().dropped == {"bad_attachment": 1, "bad_transform": 1, "bad_range_limits": 1}
    assert not rig.scans


def test_so_many_robots_and_no_more() -> None:
    rig = Rig()
    for number in range(5):
        rig.scan(S, Origin(f"r{number}", None))
    assert len(rig.intake.report()) == 3
    assert rig.intake.strangers == 2


def test_so_many_sensors_and_no_more() -> None:
    rig = Rig()
    for number in range(66):
        rig.scan(S, Origin("r1", f"s{number}"), gid=bytes([number]) * 16)
    assert rig.status().dropped == {"too_many_sensors": 2}


def test_poses_from_odometry() -> None:
    rig = Rig(pose_from="odometry")
    rig.mount()
    for second in (1, 2):
        rig.say("pose", odometry(second * S, second, 0, 0, covariance=1e-3))
    rig.scan(round(1.5 * S))
    (scan,) = rig.decoded()
    assert scan.pose.x_m == pytest.approx(2.0)
    assert scan.pose_covariance == pytest.approx((0.0, 1e-3, 5e-3, 7e-3, 11e-3, 35e-3))


def test_poses_from_a_localiser_that_names_no_child() -> None:
    rig = Rig(pose_from="pose", base_frame="base")
    rig.mount()
    rig.scan(round(1.5 * S))
    for second in (1, 2):
        rig.say("pose", pose(second * S, 0, second, pi / 2))
    (scan,) = rig.decoded()
    assert scan.pose == pytest.approx((0.0, 2.0, pi / 2))


def test_motion_within_a_sweep_waits_for_its_end() -> None:
    rig = Rig(wait_s=1.0)
    rig.mount()
    rig.drive(0, 1)
    rig.scan(round(0.9 * S), time_increment=0.05)
    assert rig.status().waiting == 1
    rig.drive(2, 2)
    (scan,) = rig.decoded()
    assert scan.time_increment_s == 0.0
    assert scan.ranges_m[-1] != 2.0
    rig.scan(round(1.9 * S), time_increment=0.05)
    rig.clock.advance(1.1)
    rig.intake.tick()
    assert rig.status().uncorrected == 1
    assert rig.decoded()[-1].ranges_m[-1] == 2.0


def test_motion_is_left_in_when_asked_to() -> None:
    rig = Rig(correct_motion=False)
    rig.mount()
    rig.drive()
    rig.scan(S, time_increment=0.05)
    assert (rig.decoded()[0].ranges_m == 2.0).all()


@pytest.mark.parametrize(("no_returns", "expected"), [("free", np.inf), ("ignore", np.nan)])
def test_what_a_beam_without_echo_means(no_returns, expected) -> None:
    rig = Rig(no_returns=no_returns)
    rig.mount()
    rig.drive()
    rig.scan(S, ranges=[1.0, np.inf])
    assert np.array_equal(rig.decoded()[0].ranges_m, [1.0, expected], equal_nan=True)


def test_the_age_of_scans_shows_clocks_that_are_off() -> None:
    rig = Rig()
    rig.scan(1_000_000_000 * S - 3 * S)
    assert rig.status().age_s == pytest.approx(3.0)


def test_readings_at_the_ceiling_are_no_returns() -> None:
    """Drivers and simulators that give range_max, or a little more, where nothing is."""
    rig = Rig(range_ceiling_m=10.0)
    rig.mount()
    rig.drive()
    rig.scan(S, ranges=[1.0, 10.0, 11.0, np.inf, np.nan], range_max=10.0)
    (scan,) = rig.decoded()
    expected = [1.0, np.inf, np.inf, np.inf, np.nan]
    assert np.array_equal(scan.ranges_m, expected, equal_nan=True)
    assert scan.range_max_m == 10.0


def test_without_a_ceiling_what_is_beyond_the_maximum_says_nothing() -> None:
    rig = Rig()
    rig.mount()
    rig.drive()
    rig.scan(S, ranges=[1.0, 10.0, 11.0, 0.0], range_max=10.0)
    (scan,) = rig.decoded()
    assert scan.hits().tolist() == [True, True, False, False]
    assert not scan.no_returns().any()
