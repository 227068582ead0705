"""Scans through a real zenoh router to a stand-in for the map service."""

import threading
import time
from dataclasses import replace

import numpy as np
import pytest

from clients.errors import DeliveryError
from clients.link import SessionSettings, open_session
from clients.publisher import ScanPublisher
from gpom_core.errors import ConfigurationError
from gpom_core.scan import Pose2D, Scan
from tests.clients.conftest import running_map

SCAN = Scan(
    pose=Pose2D(1.0, 2.0, 3.0),
    ranges_m=np.linspace(1.0, 5.0, 360, dtype=np.float32),
    angle_min_rad=0.0,
    angle_increment_rad=0.01,
    range_min_m=0.1,
    range_max_m=10.0,
)


def test_scans_arrive_numbered_from_one_in_order(fake_map):
    with ScanPublisher("r1", "front", endpoints=[fake_map.endpoint], clock_ns=lambda: 77) as robot:
        robot.wait_ready(10.0)
        numbers = [robot.publish(replace(SCAN, stamp_ns=i)) for i in range(50)]
    arrived = fake_map.wait(50)
    assert numbers == [scan.seq for scan in arrived] == list(range(1, 51))
    assert [scan.stamp_ns for scan in arrived] == list(range(50))
    assert {scan.boot for scan in arrived} == {77}
    assert all(scan.reliable for scan in arrived)
    np.testing.assert_array_equal(arrived[0].ranges_m, SCAN.ranges_m)
    sample = fake_map.samples[0]
    assert str(sample.key_expr) == "gpom/v1/site/r1/scan/front"
    assert str(sample.encoding) == "application/x-gpom-scan;v=1"


@pytest.mark.parametrize("reliable", [True, False])
def test_whatever_numbers_a_scan_came_with_are_replaced(fake_map, reliable):
    with ScanPublisher("r1", endpoints=[fake_map.endpoint], reliable=reliable) as robot:
        robot.wait_ready(10.0)
        robot.publish(replace(SCAN, boot=5, seq=9, reliable=not reliable))
        boot = robot.boot
    (scan,) = fake_map.wait(1)
    assert (scan.boot, scan.seq, scan.reliable) == (boot, 1, reliable)


def test_every_stream_has_its_own_boot(fake_map):
    boots = []
    for _ in range(2):
        with ScanPublisher("r1", endpoints=[fake_map.endpoint]) as robot:
            assert robot.seq == 0
            boots.append(robot.boot)
    assert 0 < boots[0] < boots[1]


def test_threads_share_one_contiguous_stream(fake_map):
    with ScanPublisher("r1", endpoints=[fake_map.endpoint]) as robot:
        robot.wait_ready(10.0)
        threads = [
            threading.Thread(target=lambda: [robot.publish(SCAN) for _ in range(50)])
            for _ in range(4)
        ]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
    assert [scan.seq for scan in fake_map.wait(200)] == list(range(1, 201))


def test_robots_share_a_session_and_leave_it_open(fake_map):
    with open_session(SessionSettings([fake_map.endpoint])) as session:
        with ScanPublisher("a", session=session) as a, ScanPublisher("b", session=session) as b:
            for robot in (a, b):
                robot.wait_ready(10.0)
                robot.publish(SCAN)
        assert not session.is_closed()
    fake_map.wait(2)
    assert len(fake_map.scans("a")) == len(fake_map.scans("b")) == 1


def test_robot_is_alive_while_its_publisher_is_open(fake_map):
    liveliness = fake_map.session.liveliness()
    seen = liveliness.declare_subscriber("gpom/v1/site/*/alive", history=False)
    with ScanPublisher("r1", endpoints=[fake_map.endpoint]):
        assert str(seen.recv().kind) == "SampleKind.PUT"
    assert str(seen.recv().kind) == "SampleKind.DELETE"
    seen.undeclare()


@pytest.mark.parametrize("reliable", [True, False])
def test_nothing_is_lost_when_the_receiver_is_slow_and_the_publisher_leaves(fake_map, reliable):
    fake_map.delay_s = 0.001
    with ScanPublisher("r1", endpoints=[fake_map.endpoint], reliable=reliable) as robot:
        robot.wait_ready(10.0)
        for _ in range(1500):
            robot.publish(SCAN)
        assert robot.drain(30.0)
        assert robot.interruptions == 0
    assert [scan.seq for scan in fake_map.wait(1500)] == list(range(1, 1501))


def test_waiting_says_that_no_map_is_there(silent_map):
    with ScanPublisher("r1", endpoints=[silent_map.endpoint], reliable=False) as robot:
        with pytest.raises(DeliveryError, match="no map service is alive under the prefix"):
            robot.wait_ready(0.2)
        assert not robot.ready
        assert not robot.drain(0.2)


def test_waiting_says_that_the_map_does_not_subscribe(silent_map):
    silent_map.appear()
    with (
        ScanPublisher("r1", endpoints=[silent_map.endpoint]) as robot,
        pytest.raises(DeliveryError, match="does not subscribe to gpom/v1/site/r1/scan/laser"),
    ):
        robot.wait_ready(0.5)


def test_waiting_ends_when_the_map_appears(silent_map):
    def appear():
        silent_map.subscribe()
        silent_map.appear()

    with ScanPublisher("r1", endpoints=[silent_map.endpoint]) as robot:
        later = threading.Timer(0.3, appear)
        later.start()
        robot.wait_ready(10.0)
        assert robot.ready
        later.join()


def test_a_map_that_restarts_is_noticed_and_found_again():
    with running_map() as first:
        endpoint = first.endpoint
        robot = ScanPublisher("r1", endpoints=[endpoint]).__enter__()
        robot.wait_ready(10.0)
        robot.publish(SCAN)
        first.wait(1)
    deadline = time.monotonic() + 5.0
    while robot.ready and time.monotonic() < deadline:
        time.sleep(0.01)
    assert not robot.ready
    assert robot.interruptions == 1
    robot.publish(SCAN)
    with running_map(endpoint) as second:
        robot.wait_ready(20.0)
        # The new one never heard of scan 1, so the stream begins anew with what waits.
        assert [scan.seq for scan in second.wait(1)] == [1]
        robot.__exit__(None, None, None)


def test_no_router_is_a_clear_error():
    settings = SessionSettings(["tcp/127.0.0.1:9"], connect_timeout_s=0.3)
    with pytest.raises(DeliveryError, match=r"no zenoh router answers at tcp/127\.0\.0\.1:9"):
        open_session(settings)


def test_a_peer_does_not_need_a_router_now():
    settings = SessionSettings(["tcp/127.0.0.1:9"], mode="peer")
    with open_session(settings) as session, ScanPublisher("r1", session=session) as robot:
        assert not robot.ready


@pytest.mark.parametrize("endpoints", [[], ["nonsense"], ["bogus/127.0.0.1:1"]])
def test_malformed_endpoints_are_refused(endpoints):
    with pytest.raises((ConfigurationError, DeliveryError)):
        open_session(SessionSettings(endpoints, connect_timeout_s=0.3))


def test_publishing_needs_an_open_publisher():
    robot = ScanPublisher("r1")
    with pytest.raises(DeliveryError, match="not open"):
        robot.publish(SCAN)
