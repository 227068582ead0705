from math import pi

import numpy as np
import pytest

from gpom_core import wire
from gpom_core.ros.attachment import Attachment, write
from gpom_core.ros.keys import Origin
from service.clock import ManualClock
from service.ros.intake import Intake, RosMessage
from service.ros_settings import RosSettings
from tests.gpom_core.ros.samples import S, cdr, laser_scan, odometry, pose, tf
from tests.gpom_core.ros.vectors import SCAN_LITTLE

R1 = Origin("r1", None)
NOBODY = Origin(None, None)
WHOLE = {"ranges": np.full(8, 2.0), "angle_increment": pi / 8}


class Rig:
    """An intake with what comes out of it."""

    def __init__(self, **settings) -> None:
        self.clock = ManualClock()
        self.scans = []
        self.intake = Intake(
            RosSettings(transports=("rmw_zenoh",), **settings),
            beams_max=1000,
            robots_max=3,
            deliver=lambda *item: self.scans.append(item),
            clock=self.clock,
        )
        self.sequence = 0

    def say(self, kind, message, origin=R1, beside=None) -> None:
        payload = message if isinstance(message, bytes) else cdr(message)
        self.intake.handle(RosMessage(kind, origin, payload, beside))

    def scan(self, stamp_ns, origin=R1, *, gid=b"g" * 16, number=None, **fields) -> None:
        self.sequence = self.sequence + 1 if number is None else number
        beside = write(Attachment(self.sequence, stamp_ns, gid))
        self.say("scan", laser_scan(stamp_ns, "laser", **{**WHOLE, **fields}), origin, beside)

    def drive(self, start_s=0, end_s=10, origin=R1) -> None:
        """The robot goes along x, 1 m a second; its laser is 0.5 m ahead."""
        for second in range(start_s, end_s + 1):
            self.say("tf", tf(("map", "base", (second, 0, 0), second * S)), origin)

    def mount(self, origin=R1) -> None:
        self.say("tf_static", tf(("base", "laser", (0.5, 0, 0), 0)), origin)

    def decoded(self):
        return [wire.decode(payload) for _, _, payload in self.scans]

    def status(self, robot="r1"):
        return self.intake.report()[robot]


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
