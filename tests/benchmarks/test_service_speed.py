"""The running service under ten robots: latency, freshness, bulk answers, losses and memory.

Processes of their own, as on a site: a service, a fleet of 10 robots with 10 scans of 360 beams a
second each, and this one that asks. Twenty seconds by default, five minutes with BENCH_FULL.
All share one machine, and what other work it has shows. One point is asked for in two ways: by
http.client, and by httpx, which takes a millisecond for itself.
"""

import http.client
import os
import re
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path

import httpx
import numpy as np
import pytest

from clients.publisher import ScanPublisher
from service.points import NPY, write_npy
from tests.benchmarks.record import Figures, record, rounded
from tests.service.rooms import HALF_M, scan_at

COMMAND = "make bench, or pytest tests/benchmarks/test_service_speed.py -m benchmark -s"
START_TIMEOUT_S = 900.0
ROBOTS, RATE_HZ, BEAMS = 10, 10, 360
LOAD_S = 300.0 if os.environ.get("BENCH_FULL") else 20.0
SETTLE_S = 5.0
PROBE_EVERY_S = 0.5
LOST_AFTER_S = 30.0
BATCH = 100_000
RECENT = {"max_age_s": "3"}
GRID = {"bbox": "0,0,25.6,25.6", "resolution": "0.1", "format": "npy"}


@dataclass(frozen=True)
class Site:
    http: str
    zenoh: str
    pid: int

    def seconds(self) -> float:
        return processor_seconds(self.pid)

    def memory_mb(self) -> float:
        status = Path(f"/proc/{self.pid}/status").read_text()
        return int(re.search(r"VmRSS:\s+(\d+)", status).group(1)) / 1024.0  # type: ignore[union-attr]


def processor_seconds(pid: int) -> float:
    """That a process and its threads have used."""
    after_name = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    return (int(after_name[11]) + int(after_name[12])) / os.sysconf("SC_CLK_TCK")


def busy_seconds() -> float:
    """That all processors of the machine were not idle."""
    values = [int(v) for v in Path("/proc/stat").read_text().splitlines()[0].split()[1:9]]
    return (sum(values) - values[3] - values[4]) / os.sysconf("SC_CLK_TCK")


class Meter:
    """Cores that the service, its robots, the one that asks and strangers keep busy."""

    def __init__(self, site: Site, robots: int) -> None:
        self._read = lambda: (
            site.seconds(), processor_seconds(robots), time.process_time(), busy_seconds()
        )  # fmt: skip
        self._start_s, self._before = time.monotonic(), self._read()

    def figures(self) -> Figures:
        elapsed_s = time.monotonic() - self._start_s
        service, robots, asker, all_ = (
            (now - before) / elapsed_s
            for now, before in zip(self._read(), self._before, strict=True)
        )
        return {
            "service_cores": rounded(service),
            "robots_cores": rounded(robots),
            "asker_cores": rounded(asker),
            "strangers_cores": rounded(all_ - service - robots - asker),
        }


def gpom(*arguments: str) -> tuple[str, ...]:
    return (sys.executable, "-m", "clients.cli", *arguments)


@pytest.fixture
def site() -> Iterator[Site]:
    flags = ("--port", "0", "--zenoh-listen", "tcp/127.0.0.1:0")
    # The service takes what begins with GPOM_ for its settings.
    ours = {name: value for name, value in os.environ.items() if not name.startswith("GPOM_")}
    serve = gpom("serve", *flags)
    with subprocess.Popen(serve, stdout=subprocess.PIPE, text=True, env=ours) as process:
        try:
            found = re.search(r"http=(\S+) zenoh=(\S+)", process.stdout.readline())  # type: ignore[union-attr]
            assert found is not None
            site = Site(found.group(1), found.group(2), process.pid)
            end_s = time.monotonic() + START_TIMEOUT_S
            while httpx.get(f"{site.http}/readyz").status_code != 200:
                assert time.monotonic() < end_s, "not ready in time"
                time.sleep(0.5)
            yield site
        finally:
            process.terminate()


def latency_ms(call: Callable[[], httpx.Response]) -> float:
    start_s = time.perf_counter()
    call().raise_for_status()
    return 1e3 * (time.perf_counter() - start_s)


def one_point_ms(connection: http.client.HTTPConnection, x: float, y: float) -> float:
    """Of an answer, without what a comfortable client adds."""
    start_s = time.perf_counter()
    connection.request("GET", f"/v1/query?x={x}&y={y}")
    with connection.getresponse() as answer:
        answer.read()
        assert answer.status == 200
    return 1e3 * (time.perf_counter() - start_s)


def percentiles(name: str, values: list[float], *shares: int) -> Figures:
    return {f"{name}_p{s}": rounded(float(np.percentile(values, s))) for s in shares}


def freshness_ms(client: httpx.Client, publisher: ScanPublisher, number: int) -> float:
    """From publication of a scan of a room that nobody saw to its wall being known."""
    x = 200.0 + 10.0 * number
    publisher.publish(scan_at(x, 0.0, room=(x, 0.0)))
    start_s = time.perf_counter()
    while not client.get("/v1/query", params={"x": x + HALF_M, "y": 0.1}).json()["known"][0]:
        if time.perf_counter() - start_s > LOST_AFTER_S:
            break
        time.sleep(0.01)
    return 1e3 * (time.perf_counter() - start_s)


@pytest.mark.benchmark
@pytest.mark.timeout(3600)
def test_a_fleet_and_its_questions(site: Site) -> None:
    fleet = gpom(
        "simulate", "--robots", str(ROBOTS), "--rate", str(RATE_HZ), "--beams", str(BEAMS),
        "--duration", str(LOAD_S + SETTLE_S), "--connect", site.zenoh,
    )  # fmt: skip
    one, by_httpx, fresh, grids, recent, memory, backlog = [], [], [], [], [], [], []
    address = site.http.removeprefix("http://")
    with (
        closing(http.client.HTTPConnection(address, timeout=60.0)) as connection,
        httpx.Client(base_url=site.http, timeout=60.0) as client,
        ScanPublisher("probe", endpoints=[site.zenoh]) as publisher,
        subprocess.Popen(fleet, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL) as robots,
    ):
        publisher.wait_ready(60.0)
        while len(client.get("/v1/status").json()["robots"]) < ROBOTS:
            time.sleep(0.2)
        time.sleep(SETTLE_S)
        end_s, number, meter = time.monotonic() + LOAD_S, 0, Meter(site, robots.pid)
        while time.monotonic() < end_s:
            for x in np.linspace(1.0, 25.0, 10):
                where = {"x": str(x), "y": "8.0"}
                by_httpx.append(latency_ms(lambda w=where: client.get("/v1/query", params=w)))
                one.append(one_point_ms(connection, float(x), 8.5))
            fresh.append(freshness_ms(client, publisher, number))
            # This one first: of the newest just drawn it would tell nothing.
            recent.append(latency_ms(lambda: client.get("/v1/grid", params=GRID | RECENT)))
            grids.append(latency_ms(lambda: client.get("/v1/grid", params=GRID)))
            status = client.get("/v1/status").json()
            backlog.append(status["scans_received"] - status["scans_integrated"])
            memory.append(site.memory_mb())
            number += 1
            time.sleep(PROBE_EVERY_S)
        cores = meter.figures()
        robots.wait(120.0)
        status = client.get("/v1/status").json()
        client.post("/v1/flush", json={"timeout_s": 60.0}).raise_for_status()
        idle_one = [one_point_ms(connection, 5.0, 5.0) for _ in range(200)]
        points = np.random.default_rng(0).uniform((0.0, 0.0), (30.0, 20.0), (BATCH, 2))
        body, headers = write_npy(points), {"Content-Type": NPY}
        where = "/v1/query?method=field"
        bulk = [
            latency_ms(lambda: client.post(where, content=body, headers=headers)) for _ in range(25)
        ]
        # A little apart, or they would come from the store of rasters.
        boxes = [f"{i / 1000},0,{25.6 + i / 1000},25.6" for i in range(40)]
        idle_grids = [
            latency_ms(lambda b=box: client.get("/v1/grid", params=GRID | {"bbox": b}))
            for box in boxes
        ]
    figures: Figures = {
        "load_s": LOAD_S,
        "scans_received": float(status["scans_received"]),
        "scans_lost": float(sum(robot["lost"] for robot in status["robots"])),
        "backlog_max": float(max(backlog)),
        "memory_first_mb": rounded(memory[0]),
        "memory_last_mb": rounded(memory[-1]),
        **cores,
        **percentiles("one_point_under_load_ms", one, 50, 95, 99),
        **percentiles("one_point_by_httpx_under_load_ms", by_httpx, 50, 95, 99),
        **percentiles("freshness_ms", fresh, 50, 95),
        **percentiles("grid_256_under_load_ms", grids, 50, 95),
        **percentiles("grid_256_3_s_old_under_load_ms", recent, 50, 95),
        **percentiles("one_point_idle_ms", idle_one, 50, 99),
        **percentiles("grid_256_idle_ms", idle_grids[-20:], 50, 95),
        "bulk_points_per_s": rounded(1e3 * BATCH / float(np.median(bulk[-10:]))),
    }
    record("service", COMMAND, figures)
    assert figures["scans_lost"] == 0.0
