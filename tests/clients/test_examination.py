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


def test_namespaces_may_be_deep_and_complete_each_other() -> None:
    """Frames of two robots have the same names; the first name of their topics is the same too."""
    messages = [heard("tf_static", tf(("map", "odom", (0, 0, 0), 0)), START_NS)]
    for index, robot in enumerate(("fleet/r1", "fleet/r2")):
        frame = f"laser{index}"
        messages.append(heard(f"{robot}/tf_static", tf(("base", frame, (0, 0, 0), 0)), START_NS))
        for tenth in range(20):
            at = START_NS + tenth * S // 10
            messages.append(heard(f"{robot}/tf", tf(("odom", "base", (index, 0, 0), at)), at))
            messages.append(heard(f"{robot}/front/scan", laser_scan(at, frame), at))
    one, other = examined(*messages)
    assert (one.problems, other.problems) == ((), ())
    assert 'perhaps by ros.scan_topics: ["fleet/{robot}/{sensor}/scan"]' in one.notes[0]


def test_two_robots_under_one_name_are_told() -> None:
    message = laser_scan(START_NS)
    scans = [
        Heard("rmw_zenoh", "scan", message.__msgtype__, cdr(message), START_NS, beside)
        for beside in (write(Attachment(1, START_NS, name * 16)) for name in (b"a", b"b"))
    ]
    (report,) = examined(*scans)
    assert "2 nodes publish on this topic; when they are two robots" in report.notes[0]


def test_topics_of_the_default_pattern_need_no_note() -> None:
    (report,) = examined(*drive())
    assert report.notes == ()


def test_nodes_that_disagree_are_told() -> None:
    def said(parent, name, at):
        beside = write(Attachment(1, at, name * 16))
        message = tf((parent, "base", (0, 0, 0), at))
        return Heard("rmw_zenoh", "r1/tf", message.__msgtype__, cdr(message), at, beside)

    fixed = heard("r1/tf_static", tf(("base", "laser", (0, 0, 0), 0)), START_NS)
    times = [START_NS + tenth * S // 10 for tenth in range(20)]
    scans = [heard("r1/scan", laser_scan(at), at) for at in times]
    twice = [said("map", name, at) for at in times for name in (b"a", b"b")]
    assert "2 nodes publish the transform from map to base" in problem_of(fixed, *twice, *scans)
    parents = [said(parent, b"a", at) for at in times for parent in ("map", "odom")]
    assert "base hangs on odom and on map by turns" in problem_of(fixed, *parents, *scans)


def test_two_lasers_on_one_topic_are_placed_each_by_its_frame() -> None:
    messages = list(drive())
    rear = [heard("r1/scan", laser_scan(m.arrived_ns, "rear"), m.arrived_ns) for m in messages]
    assert "no frame is called rear" in problem_of(*messages, *rear[:3], *drive(scans=1))


def test_simulation_time_is_no_clock_that_is_off() -> None:
    fixed = heard("r1/tf_static", tf(("map", "laser", (0, 0, 0), 0)), START_NS)
    at = 1_700_000_000 * S
    scans = [heard("r1/scan", laser_scan(n * S // 10), at + n * S // 10) for n in range(20)]
    (report,) = examined(fixed, *scans)
    assert report.problems == ()
    assert "simulation time" in report.notes[0]


def test_transforms_that_are_none_are_told() -> None:
    examination = Examination()
    for message in drive():
        examination.hear(message)
    examination.hear(heard("r1/tf", tf(("base", "wheel", (np.nan, 0, 0), START_NS)), START_NS))
    (trouble,) = examination.troubles
    assert "r1/tf (rmw_zenoh): from base to wheel" in trouble
