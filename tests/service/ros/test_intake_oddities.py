"""What real fleets say that no textbook has: odd numbers, clocks, frames and mountings."""

from math import pi

import numpy as np
import pytest

from gpom_core.ros.keys import Origin
from tests.gpom_core.ros.samples import S, laser_scan, tf
from tests.gpom_core.ros.vectors import SCAN_LITTLE
from tests.service.ros.rig import NOBODY, WHOLE, Rig


def test_two_publishers_on_one_topic_are_followed_each_by_its_numbers() -> None:
    """As of two lasers that both publish on /scan."""
    rig = Rig()
    rig.mount()
    rig.drive()
    numbers = [(b"f", 5), (b"r", 70), (b"f", 6), (b"r", 71), (b"f", 8), (b"r", 72)]
    for tenth, (name, number) in enumerate(numbers, 10):
        rig.scan(tenth * S // 10, gid=name * 16, number=number)
    rig.scan(15 * S // 10, gid=b"r" * 16, number=72)
    boots = {scan.boot for scan in rig.decoded()}
    assert [scan.seq for scan in rig.decoded()] == [1, 1, 2, 3, 5, 6]  # one is lost
    assert len(boots) == 2
    assert rig.status().dropped == {"repeated": 1}


def test_a_publisher_that_counts_anew_under_its_old_name_is_heard() -> None:
    rig = Rig()
    rig.mount()
    rig.drive()
    for second, number in ((1, 500), (2, 501), (3, 1), (4, 2)):
        rig.scan(second * S, number=number)
    assert [scan.seq for scan in rig.decoded()] == [1, 2, 1, 2]
    assert not rig.status().dropped


def test_one_mad_number_spoils_nothing() -> None:
    rig = Rig()
    rig.mount()
    rig.drive()
    for second, number in ((1, 1), (2, 2**62), (3, 2**62 + 1), (4, 3)):
        rig.scan(second * S, number=number)
    assert [scan.seq for scan in rig.decoded()] == [1, 1, 2, 1]


def test_a_laser_without_transforms_shows_while_another_is_well() -> None:
    rig = Rig(wait_s=2.0)
    rig.mount()
    rig.drive()
    for tenth in range(10, 40):
        rig.scan(tenth * S // 10, Origin("r1", "front"), gid=b"f" * 16, number=tenth)
        rear = laser_scan(tenth * S // 10, "rear", **WHOLE)
        rig.say("scan", rear, Origin("r1", "rear"))
        rig.clock.advance(0.1)
        rig.intake.tick()
    assert len(rig.scans) == 30
    assert "no frame is called rear" in rig.status().problem
    rig.say("tf_static", tf(("base", "rear", (-0.5, 0, pi), 0)))
    assert rig.status().problem is None


def test_what_cannot_be_read_is_told_for_a_while() -> None:
    rig = Rig()
    rig.mount()
    rig.drive()
    rig.say("scan", SCAN_LITTLE[:60])
    rig.scan(S)
    assert "are no sensor_msgs/msg/LaserScan" in rig.status().problem
    rig.clock.advance(11.0)
    assert rig.status().problem is None
    assert rig.status().dropped == {"bad_cdr": 1}


def test_one_bad_joint_does_not_take_the_others_along() -> None:
    rig = Rig()
    joints = tf(
        ("base", "wheel", (np.nan, 0, 0), 0),
        ("laser", "laser", (0, 0, 0), 0),
        ("base", "laser", (0.5, 0, 0), 0),
    )
    rig.say("tf_static", joints)
    rig.drive()
    rig.scan(S)
    assert rig.decoded()[0].pose.x_m == 1.5
    assert rig.status().dropped == {"bad_transform": 1}


def test_a_simulation_is_placed_by_its_own_time() -> None:
    """Stamps near zero, with the clock of the service where it is."""
    rig = Rig()
    rig.mount()
    rig.drive(0, 3)
    for tenth in range(31):
        rig.scan(tenth * S // 10)
    assert [scan.pose.x_m for scan in rig.decoded()] == pytest.approx(
        [0.5 + tenth / 10 for tenth in range(31)]
    )


@pytest.mark.parametrize("first", ["tf", "scan"])
def test_a_simulation_that_begins_anew_is_not_placed_by_its_last_run(first) -> None:
    rig = Rig()
    rig.mount()
    rig.say("tf_static", tf(("map", "world", (0, 0, 0), 0)))
    rig.drive(0, 20)
    rig.scan(20 * S)
    if first == "scan":
        rig.scan(2 * S)
    for second in (1, 2, 3):  # somewhere else
        rig.say("tf", tf(("map", "base", (100, 0, 0), second * S)))
    if first == "tf":
        rig.scan(2 * S)
    assert [scan.pose.x_m for scan in rig.decoded()] == pytest.approx([20.5, 100.5])


def test_a_laser_whose_clock_is_off_does_not_spoil_another_on_its_topic() -> None:
    rig = Rig()
    rig.mount()
    rig.say("tf_static", tf(("base", "rear", (-0.5, 0, 0), 0)))
    rig.drive(0, 20)
    for second in range(10, 20):
        rig.scan(second * S, gid=b"f" * 16, number=second)
        rig.say("scan", laser_scan((second - 8) * S, "rear", **WHOLE))
    assert len(rig.scans) == 20
    assert not rig.status().dropped


def test_simulation_time_here_and_real_time_there_is_called_by_its_name() -> None:
    rig = Rig()
    rig.mount()
    rig.drive()
    rig.scan(1_000_000_000 * S)
    rig.clock.advance(1.0)
    rig.intake.tick()
    assert "simulation time (use_sim_time), or no stamp" in rig.status().problem


def test_a_laser_upside_down_sees_the_other_way_round() -> None:
    """Hung by roll = pi: what it sees on its left is on the right of the robot."""
    rig = Rig()
    message = tf(("base", "laser", (0.0, 0.0, 0.0), 0))
    rotation = message.transforms[0].transform.rotation
    rotation.x, rotation.w = 1.0, 0.0
    rig.say("tf_static", message)
    rig.drive()
    rig.scan(S, ranges=[1.0, 2.0, 3.0], angle_min=0.0, angle_increment=pi / 4)
    (scan,) = rig.decoded()
    assert scan.beam_angles_rad() == pytest.approx([0.0, -pi / 4, -pi / 2])


def test_a_scanner_that_sweeps_backwards_is_corrected_alike() -> None:
    forth, back = Rig(), Rig()
    ranges = np.linspace(3.0, 3.2, 8)
    for rig, turn in ((forth, 1.0), (back, -1.0)):
        rig.say("tf_static", tf(("base", "laser", (0.0, 0.0, 0.0), 0)))
        rig.drive()
        rig.scan(S, ranges=ranges, angle_min=-turn, angle_increment=turn * 0.3, time_increment=0.02)
    (one,), (other,) = forth.decoded(), back.decoded()
    assert one.beam_angles_rad() == pytest.approx(-other.beam_angles_rad())
    assert one.ranges_m == pytest.approx(other.ranges_m)
    assert one.ranges_m[-1] != pytest.approx(ranges[-1])


def test_frames_of_the_ros_1_way_are_those_of_the_settings() -> None:
    rig = Rig(map_frame="/map")
    rig.say("tf_static", tf(("/map", "/base", (3, 0, 0), 0), ("base", "/laser", (0.5, 0, 0), 0)))
    rig.say("scan", laser_scan(S, "/laser", **WHOLE))
    assert rig.decoded()[0].pose.x_m == 3.5


def test_a_forgotten_prefix_is_pointed_at() -> None:
    rig = Rig()
    chain = ("map", "r1/base", (1, 0, 0), S), ("r1/base", "r1/laser", (0, 0, 0), S)
    rig.say("tf", tf(*chain), NOBODY)
    rig.scan(S)
    rig.clock.advance(1.0)
    rig.intake.tick()
    assert "no frame is called laser, but there is r1/laser" in rig.status().problem


def test_two_parents_of_one_frame_are_named() -> None:
    rig = Rig()
    rig.mount()
    for tenth in range(20):
        stamp_ns = tenth * S // 10
        rig.say("tf", tf(("map", "base", (1, 0, 0), stamp_ns)))
        rig.say("tf", tf(("odom", "base", (1, 0, 0), stamp_ns)))
    rig.say("tf", tf(("map", "base", (1, 0, 0), 2 * S)))
    rig.scan(S)
    assert "base is said to hang on odom too" in rig.status().problem
