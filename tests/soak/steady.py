"""Steady load on the real service, watched from outside: `make soak`, 30 minutes.

Four robots drive laps through sixteen rooms, ten scans of 180 beams a second each, every reading
with an error of its own, so that evidence changes and experts are trained all the time; one query
and one raster are asked every five seconds. Afterwards all that was sent must be stored and in the
map. Memory, file descriptors and threads of the service in the last fifth of the time are compared
with those in the second fifth, when the map of the place was complete.
"""

import random
import sys
import tempfile
import time
from dataclasses import replace
from pathlib import Path
from statistics import median
from typing import NamedTuple

import numpy as np

from gpom_core.scan import Scan
from tests.faults.parts import Robot, Service, assert_nothing_lost, processor_s
from tests.service.rooms import scan_at

ROBOTS = 4
RATE_HZ = 10.0
ROOMS = 4  # along each edge of the site, 8 m apart
LAP_SCANS = 160  # of one robot: sixteen seconds
LAPS = 5  # with other errors
NOISE_M = 0.01
SAMPLE_S = 5.0
MEMORY_SHARE_MAX = 1.05
COUNT_MORE_MAX = 2


class Sample(NamedTuple):
    """What the operating system says of the service."""

    memory_mb: float
    files: float
    threads: float


def sample(pid: int) -> Sample:
    status = dict(
        line.split(":", 1) for line in Path(f"/proc/{pid}/status").read_text().splitlines()
    )
    return Sample(
        int(status["VmRSS"].split()[0]) / 1024.0,
        sum(1 for _ in Path(f"/proc/{pid}/fd").iterdir()),
        int(status["Threads"]),
    )


def drive(number: int) -> list[Scan]:
    """Laps of one robot through all rooms, beginning at another one than the other robots."""
    chance = np.random.default_rng(number)
    scans = []
    for i in range(LAPS * LAP_SCANS):
        along = i % LAP_SCANS * ROOMS**2 // LAP_SCANS + number * ROOMS
        column, row = along % ROOMS, along // ROOMS % ROOMS
        room = 8.0 * column, 8.0 * row
        x, y = chance.uniform(-1.5, 1.5, 2) + room
        scan = scan_at(x, y, room=room)
        error = chance.normal(0.0, NOISE_M, len(scan.ranges_m)).astype(np.float32)
        scans.append(replace(scan, ranges_m=scan.ranges_m + error))
    return scans


def summary(samples: list[Sample]) -> Sample:
    return Sample(*(median(values) for values in zip(*samples, strict=True)))


def watch(service: Service, duration_s: float) -> tuple[list[Sample], float]:
    """Ask questions for a while; what the process was like then, and the slowest point query."""
    samples, slowest_s, chance = [], 0.0, random.Random(1)
    end = time.monotonic() + duration_s
    while time.monotonic() < end:
        start = time.monotonic()
        x, y = chance.uniform(-3, 27), chance.uniform(-3, 27)
        assert service.get(f"/v1/query?x={x}&y={y}").is_success
        slowest_s = max(slowest_s, time.monotonic() - start)
        box = f"{x},{y},{x + 5.0},{y + 5.0}"
        assert service.get(f"/v1/grid?bbox={box}&resolution=0.1&format=npy").is_success
        samples.append(sample(service.process.pid))
        time.sleep(SAMPLE_S)
    return samples, slowest_s


def main(duration_s: float) -> int:
    with tempfile.TemporaryDirectory() as folder:
        service = Service(Path(folder))
        robots = [Robot(f"robot-{i}", service.endpoint, RATE_HZ, drive(i)) for i in range(ROBOTS)]
        started: list[Robot] = []
        try:
            service.start()
            service.wait_ready(600.0)
            for robot in robots:
                robot.start()
                started.append(robot)
            samples, slowest_s = watch(service, duration_s)
            for robot in robots:
                robot.finish()
            scans = assert_nothing_lost(service, robots)
            used_s = processor_s(service.process.pid)
        finally:
            for robot in started:
                robot.abandon()
            service.kill()
    fifth = max(1, len(samples) // 5)
    early, late = summary(samples[fifth : 2 * fifth]), summary(samples[-fifth:])
    most = Sample(*(max(values) for values in zip(*samples, strict=True)))
    print(
        f"soak seconds={duration_s:g} scans={scans} scans_per_s={scans / duration_s:.1f} "
        f"asked_for={ROBOTS * RATE_HZ:g} lost=0 slowest_query_s={slowest_s:.2f} "
        f"processor_s={used_s:.0f}\nearly={early}\nlate={late}\nmost={most}"
    )
    flat = late.memory_mb <= MEMORY_SHARE_MAX * early.memory_mb and all(
        late[i] <= early[i] + COUNT_MORE_MAX for i in (1, 2)
    )
    print("flat" if flat else "NOT FLAT")
    return 0 if flat else 1


if __name__ == "__main__":
    sys.exit(main(float(sys.argv[1]) if len(sys.argv) > 1 else 1800.0))
