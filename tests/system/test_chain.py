"""The whole chain: robots, a router, the service, questions; against the mapper on its own."""

import json
import re
import subprocess
import sys
import time
from collections.abc import Iterator

import numpy as np
import pytest
import zenoh

from clients.map_client import MapClient
from clients.publisher import ScanPublisher
from gpom_core.mapper import Mapper
from gpom_core.scan import Scan
from tests.service.fleet_link import locator
from tests.service.rooms import scan_at

START_TIMEOUT_S = 300.0  # compiles every loop when nothing is cached
SCANS = 20


@pytest.fixture
def router() -> Iterator[str]:
    """A zenoh router, as deployments have one; its endpoint."""
    config = zenoh.Config()
    for path, value in {
        "mode": "router",
        "listen/endpoints": ["tcp/127.0.0.1:0"],
        "scouting/multicast/enabled": False,
        "scouting/gossip/enabled": False,
        "transport/shared_memory/enabled": False,
        "adminspace/enabled": True,
    }.items():
        config.insert_json5(path, json.dumps(value))
    with zenoh.open(config) as session:
        yield locator(session, "router")


@pytest.fixture
def service(router: str) -> Iterator[MapClient]:
    """`gpom serve` as a process, behind the router; a client of it, ready."""
    flags = ("--port", "0", "--zenoh-listen", "", "--zenoh-connect", router)
    command = (sys.executable, "-m", "clients.cli", "serve", *flags)
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:
        try:
            found = re.search(r"http=(\S+)", process.stdout.readline())
            with MapClient(found.group(1)) as client:
                end_s = time.monotonic() + START_TIMEOUT_S
                while not client.ready():
                    assert time.monotonic() < end_s, "not ready in time"
                    time.sleep(0.1)
                yield client
        finally:
            process.terminate()
            assert process.wait(10.0) == 0


def _drive(x_m: float, y_m: float) -> list[Scan]:
    return [scan_at(x_m + 0.1 * step, y_m + 0.05 * step) for step in range(SCANS)]


@pytest.mark.slow
@pytest.mark.timeout(START_TIMEOUT_S + 60.0)
def test_two_robots_make_the_map_that_their_scans_make(service: MapClient, router: str) -> None:
    drives = {"r1": _drive(-1.5, -1.5), "r2": _drive(-0.5, 0.5)}
    for robot, scans in drives.items():
        with ScanPublisher(robot, endpoints=[router]) as publisher:
            publisher.wait_ready(30.0)
            for scan in scans:
                publisher.publish(scan)
            end_s = time.monotonic() + 30.0
            while robot not in {seen.id for seen in service.status().robots if seen.scans == SCANS}:
                assert time.monotonic() < end_s, "not all scans arrived"
                time.sleep(0.02)
            (seen,) = (seen for seen in service.status().robots if seen.id == robot)
            assert seen.alive
    status = service.flush()
    assert status.scans_integrated == 2 * SCANS
    assert status.dirty_experts == 0
    assert [(seen.id, seen.scans, seen.lost) for seen in status.robots] == [
        ("r1", SCANS, 0),
        ("r2", SCANS, 0),
    ]

    alone = Mapper()
    for scan in (*drives["r1"], *drives["r2"]):
        alone.update(scan)
    expected = alone.train()
    points = np.random.default_rng(0).uniform(-4.0, 4.0, (500, 2))
    served = service.query(points)
    assert served.map_version == status.map_version
    # The same evidence; hyperparameters and calibration may have been learned at other moments.
    difference = np.abs(served.occupancy - expected.query(points).occupancy)
    assert np.median(difference) < 0.02
    assert np.quantile(difference, 0.95) < 0.2
