"""What a ROS message costs, and how soon scans of a fleet are in the journal."""

import subprocess
import sys
import time
from math import pi

import numpy as np
import pytest

from gpom_core.frames import FrameTree
from gpom_core.ros.keys import Origin
from gpom_core.ros.messages import read_sweep, read_transforms
from gpom_core.sweep import to_scan, to_still_scan
from gpom_core.transforms import from_planar
from service.clock import SystemClock
from service.map_service import MapService, Ports
from service.priority import collect_what_is_new, share_interpreter
from service.ros.gateway import RosGateway
from service.ros.intake import Intake, RosMessage
from service.ros_settings import RosSettings
from service.settings import JournalSettings, Settings
from service.sqlite_journal import SqliteJournal
from service.zenoh_source import ZenohSource
from tests.benchmarks.test_wire_speed import microseconds
from tests.gpom_core.ros.samples import S, cdr, laser_scan, tf
from tests.service.conftest import wait_until

ROBOTS, RATE_HZ, SECONDS = 10, 40.0, 15.0


@pytest.mark.benchmark
@pytest.mark.parametrize("beams", [360, 1440])
def test_cost_of_a_message(beams: int) -> None:
    scan = cdr(laser_scan(S, "laser", np.full(beams, 3.0), angle_increment=2 * pi / beams))
    moved = cdr(tf(("odom", "base", (1, 2, 0.3), S)))
    sweep = read_sweep(scan, beams)
    tree = FrameTree()
    tree.add("base", "laser", from_planar(0.1, 0, 0), None)
    for second in range(100):
        tree.add("odom", "base", from_planar(second, 0, 0), second * S)
        tree.add("map", "odom", from_planar(0, second, 0), second * S)
    first, last = from_planar(0, 0, 0), from_planar(0.1, 0, 0.1)
    intake = Intake(
        RosSettings(transports=("bridge",)),
        beams_max=beams,
        robots_max=1,
        deliver=lambda *_: None,
        clock=SystemClock(),
    )
    fixed = cdr(tf(("map", "odom", (0, 0, 0), 0), ("odom", "base", (0, 0, 0), 0)))
    r1 = Origin("r1", None)
    intake.handle(RosMessage("tf_static", r1, fixed))
    intake.handle(RosMessage("tf_static", r1, cdr(tf(("base", "laser", (0, 0, 0), 0)))))
    scan_message, tf_message = RosMessage("scan", r1, scan), RosMessage("tf", r1, moved)
    costs = {
        "scan read": microseconds("read(p, 2000)", read=read_sweep, p=scan),
        "transform read": microseconds("list(read(p))", read=read_transforms, p=moved),
        "chain of three looked up": microseconds(
            "look('map', 'laser', 50500000000)", look=tree.lookup
        ),
        "placed": microseconds("f(s, p)", f=to_scan, s=sweep, p=first),
        "placed and motion corrected": microseconds(
            "f(s, p, q)", f=to_still_scan, s=sweep, p=first, q=last
        ),
        "whole scan, from message to bytes": microseconds("f(m)", f=intake.handle, m=scan_message),
    }
    costs["whole transform"] = microseconds("f(m)", f=intake.handle, m=tf_message)
    print(f"\n{beams} beams: " + ", ".join(f"{name} {us:.0f} us" for name, us in costs.items()))
    assert costs["whole scan, from message to bytes"] < 2000


class _TimedJournal(SqliteJournal):
    """Notes how old scans are when they are durable."""

    ages_s: list[float]

    def append(self, records) -> None:
        super().append(records)
        now_ns = time.time_ns()
        self.ages_s += [(now_ns - record.scan.stamp_ns) / 1e9 for record in records]


@pytest.mark.benchmark
@pytest.mark.timeout(300)
def test_ten_robots_at_forty_hertz(tmp_path) -> None:
    # Room for all: how soon they are in the map is another question, and its answer depends on
    # how much of it is new.
    settings = Settings(ingest={"backlog_scans_max": 10_000})
    ros = RosSettings(transports=("rmw_zenoh",))
    gateway = RosGateway(ros, beams_max=2000, robots_max=20)
    zenoh = settings.zenoh.model_copy(update={"listen": ("tcp/127.0.0.1:0",)})
    source = ZenohSource(zenoh, [gateway])
    journal = _TimedJournal(tmp_path / "journal.sqlite", JournalSettings())
    journal.ages_s = []
    service = MapService(settings, Ports(source, journal))
    share_interpreter()  # as the service's own process does
    service.start()
    collect_what_is_new()
    try:
        wait_until(lambda: not service.troubles(), 300.0)
        module = "tests.benchmarks.ros_fleet"
        numbers = [str(number) for number in (ROBOTS, RATE_HZ, SECONDS)]
        command = [sys.executable, "-m", module, service.endpoints[0], *numbers]
        started_s = time.process_time()
        subprocess.run(command, check=True)
        total = int(RATE_HZ * SECONDS) * ROBOTS
        wait_until(lambda: len(journal.ages_s) >= total, 30.0)
        busy = (time.process_time() - started_s) / SECONDS
        robots = service.fleet.robots()
    finally:
        service.stop()
    ages_ms = np.sort(journal.ages_s) * 1e3
    p50, p99, worst = np.quantile(ages_ms, [0.5, 0.99, 1.0])
    print(
        f"\n{total} scans of {ROBOTS} robots at {RATE_HZ:g} Hz, from publish to journal: p50 "
        f"{p50:.1f} ms, p99 {p99:.1f} ms, longest {worst:.1f} ms; {busy:.2f} cores with mapping"
    )
    assert sum(robot.scans for robot in robots) == total
    assert not any(robot.lost or robot.intake.dropped for robot in robots)
