import numpy as np
import pytest

from clients.examination import Examination
from clients.listener import SCAN_TYPE, Heard
from gpom_core.ros import cdr as types
from gpom_core.ros.attachment import Attachment, write
from tests.gpom_core.ros.samples import S, cdr, laser_scan, odometry, tf
from tests.service.rooms import payload_at

START_NS = 1_000 * S


def heard(topic, message, at_ns, way="rmw_zenoh", number=None) -> Heard:
    beside = None if number is None else write(Attachment(number, at_ns, b"g" * 16))
    return Heard(way, topic, message.__msgtype__, cdr(message), at_ns, beside)


def drive(robot="r1", *, scans=20, transforms=True, late_s=0.01, frame="laser", skip=()):
    if transforms:
        yield heard(f"{robot}/tf_static", tf(("base", frame, (0, 0, 0), 0)), START_NS)
    for index in range(scans):
        at = START_NS + index * S // 10
        if transforms:
            yield heard(f"{robot}/tf", tf(("map", "base", (index, 0, 0), at)), at)
        if index not in skip:
            message = laser_scan(at - round(late_s * S), frame, np.ones(30))
            yield heard(f"{robot}/scan", message, at, number=index)


def examined(*messages, announced=None, **settings):
    examination = Examination(**settings)
    for message in messages:
        examination.hear(message)
    return examination.report(announced)


def test_a_healthy_robot_has_no_problems() -> None:
    (report,) = examined(*drive())
    assert report.problems == ()
    assert (report.topic, report.scans, report.beams, report.frame) == ("r1/scan", 20, 30, "laser")
    assert report.rate_hz == pytest.approx(10.0)
    assert report.lost == 0
    assert report.age_s == pytest.approx(0.01)
    assert report.placed > 0.9


def problem_of(*messages, **settings) -> str:
    (report,) = examined(*messages, **settings)
    return " ".join(report.problems)


def test_what_is_missing_is_named() -> None:
    assert "no transforms at all" in problem_of(*drive(transforms=False))
    assert "no frame is called site" in problem_of(*drive(), map_frame="site")
    assert "2 scans (10%) are lost" in problem_of(*drive(skip=(4, 9)))
    assert "3.0 s behind the clock" in problem_of(*drive(late_s=3.0))
    assert "2.0 s ahead of the clock" in problem_of(*drive(late_s=-2.0))
    assert "no frame is called radar" in problem_of(
        *drive(scans=3), heard("r1/scan", laser_scan(START_NS, "radar"), START_NS + S)
    )


def test_streams_that_are_announced_and_never_come() -> None:
    (report,) = examined(announced={("bridge", "r2/scan"): types.LASER_SCAN})
    assert report.problems == ("it is announced, but no scan came",)


def test_slow_and_broken_streams() -> None:
    slow = [heard("s/scan", laser_scan(START_NS + n * 2 * S), START_NS + n * 2 * S) for n in (0, 1)]
    assert "only 0.5 times a second" in problem_of(*slow)
    broken = Heard("bridge", "b/scan", types.LASER_SCAN, b"\x00\x07\x00\x00", START_NS, None)
    assert "cannot be read: the message is encoded as XCDR version 2" in problem_of(broken)


def test_robots_have_frames_of_their_own() -> None:
    reports = examined(*drive("r1"), *drive("r2", transforms=False))
    assert [bool(report.problems) for report in reports] == [False, True]


def test_poses_may_come_from_odometry() -> None:
    messages = [
        heard("r1/odom", odometry(START_NS + n * S, n, 0, 0, child="laser"), START_NS + n * S)
        for n in range(3)
    ]
    scan = heard("r1/scan", laser_scan(START_NS + S), START_NS + S)
    assert problem_of(*messages, scan, pose_from="odometry") == ""
    assert "no transforms at all" in problem_of(*messages, scan)


def test_native_scans_bring_their_pose() -> None:
    scans = [
        Heard("gpom", "r9/laser", SCAN_TYPE, payload_at(0, 0, seq=n, stamp_ns=n * S), n * S, None)
        for n in (1, 2, 4)
    ]
    (report,) = examined(*scans)
    assert (report.lost, report.placed, report.frame) == (1, 1.0, "")
