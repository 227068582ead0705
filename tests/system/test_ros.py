"""Three ROS 2 robots, played by a client that somebody else wrote, and `gpom serve`."""

import re
import subprocess
import sys
import time
from contextlib import contextmanager

import numpy as np
import pytest

from clients.map_client import MapClient
from clients.publisher import ScanPublisher
from tests.gpom_core.ros.samples import STORE, S
from tests.service.rooms import scan_at
from tests.system.ros_client import RosNode, RosRobot, end_session

pytest.importorskip("zenoh_ros2_sdk", reason="zenoh-ros2-sdk is not installed")

START_TIMEOUT_S = 300.0  # compiles every loop when nothing is cached
NAMES = ("robot1", "robot2", "robot3")
SCANS = 12
GRID = "nav_msgs/msg/OccupancyGrid"
RESOLUTION_M = 0.1
PLACES = np.stack(np.meshgrid(*2 * [np.arange(-4.0, 4.0, 0.1)]), axis=-1).reshape(-1, 2)
CONFIG = """map: {max_observations: 2000} # where experts are split depends on when they are trained

ros:
  transports: [rmw_zenoh]
  map: {resolution_m: 0.1, interval_s: 0.1, full_interval_s: 0.5}
"""


@contextmanager
def running(tmp_path):
    config = tmp_path / "gpom.yaml"
    config.write_text(CONFIG)
    flags = ("--port", "0", "--zenoh-listen", "tcp/127.0.0.1:0", "--config", str(config))
    command = (sys.executable, "-m", "clients.cli", "serve", *flags)
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:
        try:
            found = re.search(r"http=(\S+) zenoh=(\S+)", process.stdout.readline())
            with MapClient(found.group(1)) as client:
                end_s = time.monotonic() + START_TIMEOUT_S
                while not client.ready():
                    assert time.monotonic() < end_s, "not ready in time"
                    time.sleep(0.1)
                yield client, found.group(2)
        finally:
            process.terminate()
            assert process.wait(20.0) == 0


def drives():
    """Of each robot: scans of one room, with the pose of the laser."""
    for index, name in enumerate(NAMES):
        yield name, [scan_at(-1.5 + index, -1.2 + 0.2 * step) for step in range(SCANS)]


def wait_for(condition, timeout_s=30.0) -> None:
    end_s = time.monotonic() + timeout_s
    while not condition():
        assert time.monotonic() < end_s, "did not come true in time"
        time.sleep(0.02)


def scans_of(client, name) -> int:
    return sum(robot.scans for robot in client.status().robots if robot.id == name)


def by_ros(client, endpoint) -> None:
    start_ns = time.time_ns()
    for name, scans in drives():
        robot = RosRobot(endpoint, name)
        time.sleep(0.3)
        try:
            stamps = [start_ns + index * S // 10 for index in range(SCANS)]
            for stamp_ns, scan in zip(stamps, scans, strict=True):
                robot.scan(
                    stamp_ns,
                    scan.ranges_m,
                    angle_min=scan.angle_min_rad,
                    angle_increment=scan.angle_increment_rad,
                    range_min=scan.range_min_m,
                    range_max=scan.range_max_m,
                )
            # Nothing was known of where it was; now it is, and no scan is lost.
            wait_for(lambda robot=name: _intake(client, robot).get("waiting") == SCANS)
            robot.mount()
            for stamp_ns, scan in zip(stamps, scans, strict=True):
                robot.stand(scan.pose.x_m - 0.5, scan.pose.y_m, 0.0, stamp_ns)
            wait_for(lambda robot=name: scans_of(client, robot) == SCANS)
            wait_for(lambda robot=name: _intake(client, robot)["delayed"] == SCANS)
            assert _intake(client, name)["dropped"] == {}
            (seen,) = (robot for robot in client.status().robots if robot.id == name)
            assert (seen.alive, seen.lost) == (True, 0)
            assert seen.pose == pytest.approx(scans[-1].pose, abs=1e-9)
        finally:
            robot.close()


def by_gpom(client, endpoint) -> None:
    for name, scans in drives():
        with ScanPublisher(name, endpoints=[endpoint]) as publisher:
            publisher.wait_ready(30.0)
            for scan in scans:
                publisher.publish(scan)
            wait_for(lambda robot=name: scans_of(client, robot) == SCANS)


def _intake(client, name) -> dict:
    robots = client.status().robots
    return next((robot.details["intake"] or {} for robot in robots if robot.id == name), {})


@pytest.mark.slow
@pytest.mark.timeout(2 * START_TIMEOUT_S)
def test_three_ros_robots_make_the_same_map_and_get_it_back(tmp_path) -> None:
    maps = {}
    for way in (by_gpom, by_ros):
        with running(tmp_path) as (client, endpoint):
            way(client, endpoint)
            client.flush()
            maps[way] = client.query(PLACES)
            if way is by_ros:
                _read_back(client, endpoint)
    one, other = maps[by_gpom], maps[by_ros]
    assert np.array_equal(one.known, other.known)
    assert other.mean == pytest.approx(one.mean, abs=1e-9)
    assert other.variance == pytest.approx(one.variance, abs=1e-9)
    # Scans arrive in another order, so others are kept to calibrate by.
    assert other.occupancy == pytest.approx(one.occupancy, abs=0.05)
    assert np.abs(one.mean).max() > 0.9


def _read_back(client, endpoint) -> None:
    """Latched: the subscriber comes long after the grid."""
    grids = []
    viewer = RosNode(endpoint, "viewer")
    try:
        time.sleep(1.0)
        viewer.subscribe("/map", GRID, grids.append, latched=True)
        wait_for(lambda: len(grids) > 0)
        info, data = grids[-1].info, grids[-1].data
        x, y = info.origin.position.x, info.origin.position.y
        box = (x, y, x + info.width * RESOLUTION_M, y + info.height * RESOLUTION_M)
        occupancy = client.grid(box, RESOLUTION_M)
        known = client.grid(box, RESOLUTION_M, layer="known") > 0.5
        expected = np.where(known, np.rint(100 * occupancy), -1).astype(np.int8)
        assert np.array_equal(np.asarray(data).reshape(expected.shape), expected)
        assert {-1, 0} < set(np.unique(expected))
        again = STORE.deserialize_cdr(STORE.serialize_cdr(_ours(grids[-1]), GRID), GRID)
        assert np.array_equal(again.data, data)
    finally:
        viewer.close()
        end_session()


def _ours(grid):
    """The same message by the types of rosbags."""
    names = (name for name in grid.__dataclass_fields__ if name != "__msgtype__")
    return STORE.types[GRID](**{name: getattr(grid, name) for name in names})
