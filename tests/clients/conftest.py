"""A stand-in for the map service on a real zenoh router, on a free port of this machine."""

import json
import struct
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager

import pytest
import zenoh

from clients.keys import DEFAULT_PREFIX
from gpom_core.scan import Scan
from gpom_core.wire import decode


def router_config(endpoint: str) -> zenoh.Config:
    config = zenoh.Config()
    for key, value in {
        "mode": "router",
        "listen/endpoints": [endpoint],
        "adminspace/enabled": True,  # tells the port that was picked
        "scouting/delay": 0,  # nobody to wait for
        "scouting/multicast/enabled": False,
        "scouting/gossip/enabled": False,
        "transport/shared_memory/enabled": False,
    }.items():
        config.insert_json5(key, json.dumps(value))
    return config


class FakeMap:
    """Router and map service in one session: keeps what arrives, may be slow, may stay silent.

    `stored` are the cursors of streams; scans that are acknowledged are those it counts there.
    """

    def __init__(self, session: zenoh.Session, *, delay_s: float = 0.0) -> None:
        self.session = session
        self.delay_s = delay_s
        self.stored: dict[str, tuple[int, int]] = {}
        self.acknowledges = True
        self.drop_every = 0
        self._seen = 0
        self.samples: list[zenoh.Sample] = []
        self._arrived = threading.Condition()
        self._parts: list[object] = []

    @property
    def endpoint(self) -> str:
        (reply,) = self.session.get(f"@/{self.session.zid()}/router")
        return json.loads(reply.ok.payload.to_bytes())["locators"][0]

    def subscribe(self, prefix: str = DEFAULT_PREFIX) -> None:
        self._parts.append(self.session.declare_subscriber(f"{prefix}/*/scan/*", self._on_sample))
        self._parts.append(
            self.session.declare_queryable(f"{prefix}/*/cursor/*", self._on_cursor, complete=True)
        )

    def appear(self, prefix: str = DEFAULT_PREFIX) -> None:
        self._parts.append(self.session.liveliness().declare_token(f"{prefix}/_map/alive"))

    def vanish(self) -> None:
        for part in self._parts:
            part.undeclare()
        self._parts.clear()

    def acknowledge(self, robot: str, boot: int, seq: int, prefix: str = DEFAULT_PREFIX) -> None:
        """Say that a stream is stored so far, whatever is."""
        self.session.put(f"{prefix}/{robot}/ack/laser", struct.pack("<QQ", boot, seq))

    def wait(self, count: int, timeout_s: float = 20.0) -> list[Scan]:
        with self._arrived:
            assert self._arrived.wait_for(lambda: len(self.samples) >= count, timeout_s), (
                f"{len(self.samples)} of {count} scans arrived in {timeout_s} s"
            )
        return self.scans()

    def scans(self, robot: str | None = None) -> list[Scan]:
        return [
            decode(sample.payload.to_bytes())
            for sample in list(self.samples)
            if robot is None or f"/{robot}/scan/" in str(sample.key_expr)
        ]

    def _on_sample(self, sample: zenoh.Sample) -> None:
        time.sleep(self.delay_s)
        scan = decode(sample.payload.to_bytes())
        key = str(sample.key_expr).replace("/scan/", "/cursor/")
        if scan.reliable:
            self._seen += 1
            if self.drop_every and self._seen % self.drop_every == 0:
                return
            boot, seq = self.stored.get(key, (0, 0))
            expected = seq + 1 if scan.boot == boot else 1
            new = scan.boot >= boot and scan.seq == expected
            if new:
                self._keep(sample)  # before it is acknowledged: who has the ack may look
                self.stored[key] = (scan.boot, scan.seq)
            if self.acknowledges:
                cursor = struct.pack("<QQ", *self.stored.get(key, (0, 0)))
                self.session.put(key.replace("/cursor/", "/ack/"), cursor)
        else:
            self._keep(sample)

    def _keep(self, sample: zenoh.Sample) -> None:
        with self._arrived:
            self.samples.append(sample)
            self._arrived.notify_all()

    def _on_cursor(self, query: zenoh.Query) -> None:
        with query:
            cursor = self.stored.get(str(query.key_expr))
            query.reply(query.key_expr, b"" if cursor is None else struct.pack("<QQ", *cursor))


def close(session: zenoh.Session) -> None:
    """Close a session whose callbacks may be using it, which zenoh refuses at that moment."""
    for _ in range(500):
        try:
            return session.close()
        except RuntimeError:
            time.sleep(0.01)
    raise TimeoutError


@contextmanager
def running_map(endpoint: str = "tcp/127.0.0.1:0", *, silent: bool = False) -> Iterator[FakeMap]:
    session = zenoh.open(router_config(endpoint))
    try:
        fake = FakeMap(session)
        if not silent:
            fake.subscribe()
            fake.appear()
        yield fake
        fake.vanish()
    finally:
        close(session)


@pytest.fixture
def fake_map() -> Iterator[FakeMap]:
    """A map service that takes every scan."""
    with running_map() as fake:
        yield fake


@pytest.fixture
def silent_map() -> Iterator[FakeMap]:
    """A router with no map service behind it, until `subscribe` and `appear` are called."""
    with running_map(silent=True) as fake:
        yield fake
