"""A stand-in for the map service on a real zenoh router, on a free port of this machine."""

import json
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
    """Router and map service in one session: keeps what arrives, may be slow, may stay silent."""

    def __init__(self, session: zenoh.Session, *, delay_s: float = 0.0) -> None:
        self.session = session
        self.delay_s = delay_s
        self.samples: list[zenoh.Sample] = []
        self._arrived = threading.Condition()
        self._parts: list[object] = []

    @property
    def endpoint(self) -> str:
        (reply,) = self.session.get(f"@/{self.session.zid()}/router")
        return json.loads(reply.ok.payload.to_bytes())["locators"][0]

    def subscribe(self, prefix: str = DEFAULT_PREFIX) -> None:
        self._parts.append(self.session.declare_subscriber(f"{prefix}/*/scan/*", self._on_sample))

    def appear(self, prefix: str = DEFAULT_PREFIX) -> None:
        self._parts.append(self.session.liveliness().declare_token(f"{prefix}/_map/alive"))

    def vanish(self) -> None:
        for part in self._parts:
            part.undeclare()
        self._parts.clear()

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
        with self._arrived:
            self.samples.append(sample)
            self._arrived.notify_all()


@contextmanager
def running_map(endpoint: str = "tcp/127.0.0.1:0", *, silent: bool = False) -> Iterator[FakeMap]:
    with zenoh.open(router_config(endpoint)) as session:
        fake = FakeMap(session)
        if not silent:
            fake.subscribe()
            fake.appear()
        yield fake
        fake.vanish()


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
