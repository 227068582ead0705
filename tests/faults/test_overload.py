"""More comes than can be handled: nothing grows without bound, and it ends when the load ends."""

import os
import signal
import subprocess
import sys
import time

import pytest

from tests.faults.parts import ROOT, Robot, Service, assert_nothing_lost, until
from tests.soak.steady import sample


@pytest.mark.fault
@pytest.mark.timeout(600)
def test_ten_times_the_sustainable_load_for_a_minute(tmp_path, run) -> None:
    """Reliable robots are slowed down by their outbox; questions are answered meanwhile."""
    service = Service(tmp_path)
    run(service)
    service.wait_ready()
    robots = [
        Robot(f"robot-{i}", service.endpoint, 5000.0, scans_max=1024, window=512) for i in range(4)
    ]
    before = sample(service.process.pid)
    run(*robots)
    slowest_s, most_mb = 0.0, 0.0
    end = time.monotonic() + 60.0
    while time.monotonic() < end:
        start = time.monotonic()
        assert service.get("/v1/query?x=0&y=0").is_success
        slowest_s = max(slowest_s, time.monotonic() - start)
        most_mb = max(most_mb, sample(service.process.pid).memory_mb)
        time.sleep(0.5)
    for robot in robots:
        robot.finish()
    ended = time.monotonic()
    scans = assert_nothing_lost(service, robots)
    recovered_s = time.monotonic() - ended
    print(
        f"overload seconds=60 scans={scans} lost=0 slowest_query_s={slowest_s:.2f} "
        f"memory_mb={before.memory_mb:.0f}..{most_mb:.0f} recovered_after_s={recovered_s:.1f}"
    )
    assert most_mb < before.memory_mb + 500.0


_ROBOT = """
import sys, time
from dataclasses import replace
from pathlib import Path
from clients.outbox import OutboxSettings
from clients.publisher import ScanPublisher
from tests.service.rooms import scan_at
endpoint, outbox, wanted = sys.argv[1], Path(sys.argv[2]), int(sys.argv[3])
with ScanPublisher("robot", endpoints=[endpoint], outbox=OutboxSettings(path=outbox)) as robot:
    scan = scan_at()
    while robot.seq < wanted:
        robot.publish(replace(scan, stamp_ns=robot.seq + 1))
        print(robot.seq, flush=True)
        time.sleep(0.01)
    sys.exit(not robot.drain(60.0))
"""


@pytest.mark.timeout(400)
@pytest.mark.parametrize("kills", [pytest.param(2, id="short")])
def test_a_robot_is_killed_and_goes_on_from_its_disk(tmp_path, run, kills) -> None:
    service = Service(tmp_path)
    run(service)
    service.wait_ready()
    wanted = 300

    def start() -> subprocess.Popen:
        return subprocess.Popen(
            [
                sys.executable,
                *("-c", _ROBOT, service.endpoint, str(tmp_path / "outbox"), str(wanted)),
            ],
            stdout=subprocess.PIPE,
            text=True,
            cwd=ROOT,
            env={**os.environ, "PYTHONPATH": str(ROOT)},
        )

    for _ in range(kills):
        with start() as robot:
            for _ in range(60):
                robot.stdout.readline()
            robot.send_signal(signal.SIGKILL)
            robot.stdout.read()
    with start() as robot:
        robot.stdout.read()
        assert robot.wait(120.0) == 0
    until(lambda: service.flush()["scans_integrated"] == wanted, 60.0, "all in the map")
    assert service.stored() == {"robot": list(range(1, wanted + 1))}
    print(f"robot killed kills={kills} scans={wanted} lost=0")
