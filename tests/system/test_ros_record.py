"""What is recorded in the field makes the same map elsewhere."""

import threading
import time

import numpy as np
import pytest
from typer.testing import CliRunner

from clients.cli import app
from clients.logs import open_log
from gpom_core import Mapper, wire
from service.ros.gateway import RosGateway
from service.ros_settings import RosSettings
from service.settings import ZenohSettings
from service.zenoh_source import ZenohSource
from tests.gpom_core.ros.samples import S, laser_scan, tf
from tests.service.rooms import scan_at
from tests.service.ros.rmw import talker

SCANS = 12
PLACES = np.stack(np.meshgrid(*2 * [np.arange(-4.0, 4.0, 0.1)]), axis=-1).reshape(-1, 2)


class Sink:
    """The service, as far as it is told of scans."""

    def __init__(self) -> None:
        self.scans = []

    def on_scan(self, robot, sensor, payload) -> None:
        self.scans.append(wire.decode(payload))

    def on_presence(self, robot, alive) -> None:
        pass

    def on_intake(self, robot, status) -> None:
        pass


def drive(robot) -> None:
    robot.say("r1/tf_static", tf(("base", "laser", (0.5, 0.0, 0.0), 0)))
    start_ns = time.time_ns()
    for index in range(SCANS):
        scan, stamp_ns = scan_at(-1.5 + 0.2 * index, -1.2), start_ns + index * S // 10
        fields = {
            "angle_min": scan.angle_min_rad,
            "angle_increment": scan.angle_increment_rad,
            "range_min": scan.range_min_m,
            "range_max": scan.range_max_m,
        }
        robot.say("r1/scan", laser_scan(stamp_ns, "laser", scan.ranges_m, **fields), stamp_ns)
        place = (scan.pose.x_m - 0.5, scan.pose.y_m, 0.1 * index)
        robot.say("r1/tf", tf(("map", "base", place, stamp_ns)), stamp_ns)
        time.sleep(0.02)


def map_of(scans):
    mapper = Mapper()
    for scan in scans:
        mapper.update(scan)
    return mapper.train().query(PLACES)


@pytest.mark.timeout(400)  # compiles every loop when nothing is cached
def test_a_recorded_drive_makes_the_same_map(tmp_path) -> None:
    bag, sink = tmp_path / "field", Sink()
    gateway = RosGateway(RosSettings(transports=("rmw_zenoh",)), beams_max=1000, robots_max=9)
    source = ZenohSource(ZenohSettings(listen=("tcp/127.0.0.1:0",)), [gateway])
    source.open(sink)
    try:
        (endpoint,) = source.endpoints()
        with talker(endpoint, "rmw_zenoh") as robot:
            timer = threading.Timer(2.0, drive, (robot,))  # when the recorder listens
            timer.start()
            options = ("--seconds", "5", "--connect", endpoint)
            result = CliRunner().invoke(app, ["record", str(bag), *options])
            timer.join()
    finally:
        source.close()
    assert f"/r1/scan: {SCANS} messages" in result.stdout, result.output
    replayed = list(open_log(bag))
    assert len(sink.scans) == len(replayed) == SCANS
    for live, again in zip(sink.scans, replayed, strict=True):
        assert live.pose == again.pose
        assert np.array_equal(live.ranges_m, again.ranges_m)
    live_map, again_map = map_of(sink.scans), map_of(replayed)
    assert np.array_equal(live_map.occupancy, again_map.occupancy)
    assert np.abs(live_map.mean).max() > 0.9
