"""The real parts as processes that can be killed, stopped and started again."""

import json
import os
import socket
import sqlite3
import subprocess
import sys
import threading
import time
from collections import defaultdict
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

import httpx

from clients.outbox import OutboxSettings
from clients.publisher import ScanPublisher
from gpom_core.scan import Scan
from gpom_core.wire import decode
from tests.service.rooms import scan_at

ROOT = Path(__file__).parents[2]


def free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return probe.getsockname()[1]


def until(condition: Callable[[], bool], timeout_s: float, what: str) -> float:
    """Wait; give how long it took."""
    start = time.monotonic()
    while not condition():
        assert time.monotonic() - start < timeout_s, f"not in {timeout_s} s: {what}"
        time.sleep(0.02)
    return time.monotonic() - start


def processor_s(pid: int) -> float:
    """Processor time that a process took so far."""
    fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


class Part:
    """One process. Its output goes to a file."""

    def __init__(self, command: list[str], log: Path) -> None:
        self.command = command
        self.log = log
        self.process: subprocess.Popen | None = None

    def start(self) -> None:
        with self.log.open("ab") as log:
            self.process = subprocess.Popen(
                self.command,
                stdout=log,
                stderr=log,
                cwd=ROOT,
                env={**os.environ, "PYTHONPATH": str(ROOT)},
            )

    def send(self, number: int) -> None:
        self.process.send_signal(number)

    def kill(self) -> None:
        if self.process is not None:
            self.process.kill()
            self.process.wait(20.0)
            self.process = None


class Service(Part):
    """`gpom serve` with a data directory, at one address for good."""

    def __init__(self, directory: Path, *flags: str, connect: str = "") -> None:
        self.http = f"http://127.0.0.1:{free_port()}"
        self.endpoint = connect or f"tcp/127.0.0.1:{free_port()}"
        self.data = directory / "data"
        where = (
            ["--zenoh-listen", "", "--zenoh-connect", connect]
            if connect
            else ["--zenoh-listen", self.endpoint]
        )
        command = [sys.executable, "-m", "clients.cli", "serve", "--data-dir", str(self.data)]
        port = self.http.rpartition(":")[2]
        super().__init__([*command, "--port", port, *where, *flags], directory / "service.log")
        # One client, since making one takes tens of ms; no kept connections, since processes end.
        limits = httpx.Limits(max_keepalive_connections=0)
        self._client = httpx.Client(base_url=self.http, timeout=10.0, limits=limits)

    def get(self, path: str) -> httpx.Response:
        return self._client.get(path)

    def status(self) -> dict:
        return self.get("/v1/status").json()

    def is_ready(self) -> bool:
        try:
            return self.get("/readyz").is_success
        except httpx.HTTPError:
            return False

    def wait_ready(self, timeout_s: float = 300.0) -> float:
        """Kernels may have to be compiled, which takes minutes on a busy machine."""
        return until(self.is_ready, timeout_s, f"ready; see {self.log.read_text()[-2000:]}")

    def flush(self) -> dict:
        wanted = {"timeout_s": 500.0}
        reply = self._client.post("/v1/flush", json=wanted, timeout=510.0)
        assert reply.is_success, reply.text
        return reply.json()

    def metric(self, name: str) -> float:
        lines = self.get("/metrics").text.splitlines()
        return sum(float(line.rpartition(" ")[2]) for line in lines if line.startswith(name))

    def stored(self) -> dict[str, list[int]]:
        """Stamps of all stored scans, by robot, in the order of the journal."""
        found = defaultdict(list)
        db = sqlite3.connect(self.data / "journal.sqlite")
        try:
            rows = db.execute(
                "SELECT robot, payload FROM scans JOIN streams USING (stream) ORDER BY position"
            )
            for robot, payload in rows:
                found[robot].append(decode(payload).stamp_ns)
        finally:
            db.close()
        return dict(found)


_ROUTER = """
import json, signal, sys, threading, zenoh
config = zenoh.Config()
for path, value in json.loads(sys.argv[1]).items():
    config.insert_json5(path, json.dumps(value))
with zenoh.open(config):
    threading.Event().wait()
"""


class Router(Part):
    """A zenoh router, at one address for good."""

    def __init__(self, directory: Path, **options: object) -> None:
        self.endpoint = f"tcp/127.0.0.1:{free_port()}"
        settings = {
            "mode": "router",
            "listen/endpoints": [self.endpoint],
            "scouting/delay": 0,
            "scouting/multicast/enabled": False,
            "scouting/gossip/enabled": False,
            "transport/shared_memory/enabled": False,
            **options,
        }
        super().__init__(
            [sys.executable, "-c", _ROUTER, json.dumps(settings)], directory / "router.log"
        )

    def start(self) -> None:
        super().start()
        host, _, port = self.endpoint.removeprefix("tcp/").rpartition(":")

        def listens() -> bool:
            with socket.socket() as probe:
                return probe.connect_ex((host, int(port))) == 0

        until(listens, 30.0, "the router listens")


class Robot:
    """A robot that publishes at a rate in a thread; every scan has its number as its stamp.

    It stands still, or sends `scans` over and over.
    """

    def __init__(
        self,
        name: str,
        endpoint: str,
        rate_hz: float,
        scans: Sequence[Scan] = (),
        **outbox: object,
    ) -> None:
        self.name = name
        self.produced = 0
        self.durable: list[int] = []
        self._period_s = 1.0 / rate_hz
        self._stop = threading.Event()
        self._publisher = ScanPublisher(
            name,
            endpoints=[endpoint],
            outbox=OutboxSettings(**{"scans_max": 100_000, **outbox}),
            on_durable=self.durable.append,
        )
        self._scans = scans or [scan_at(0.2, 0.1)]
        self._thread = threading.Thread(target=self._drive)

    def start(self) -> None:
        self._publisher.__enter__()
        self._thread.start()

    def finish(self, timeout_s: float = 600.0) -> None:
        """Stop producing, and wait until all is acknowledged."""
        self._stop.set()
        self._thread.join()
        assert self._publisher.drain(timeout_s), (
            f"{self._publisher.waiting} of {self.produced} scans are not acknowledged"
        )
        self._publisher.__exit__(None, None, None)

    def abandon(self) -> None:
        self._stop.set()
        if self._thread.ident is not None:
            self._thread.join()
        self._publisher.__exit__(RuntimeError, RuntimeError(), None)

    def _drive(self) -> None:
        due = time.monotonic()
        while not self._stop.is_set():
            scan = self._scans[self.produced % len(self._scans)]
            self._publisher.publish(replace(scan, stamp_ns=self.produced + 1))
            self.produced += 1
            due = max(due + self._period_s, time.monotonic() - 0.1)
            self._stop.wait(max(0.0, due - time.monotonic()))


def assert_nothing_lost(service: Service, robots: list[Robot]) -> int:
    """All scans produced are stored once, in order, and all stored are in the map."""
    status = service.flush()
    stored = service.stored()
    for robot in robots:
        assert stored[robot.name] == list(range(1, robot.produced + 1)), robot.name
        assert robot.durable == stored[robot.name]
    total = sum(robot.produced for robot in robots)
    assert status["scans_integrated"] == total
    return total
