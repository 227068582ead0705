"""The live map as people meet it: the whole service on a real port, a page in a real Chromium."""

import asyncio
import socket
import threading
from collections.abc import Iterator
from contextlib import AbstractContextManager
from typing import Any, Self

import httpx
import pytest
import uvicorn

from service.http.app import create_app
from service.map_service import MapService, Ports
from service.settings import HttpSettings, Settings
from service.source import MemorySource
from tests.browser.chromium import PROGRAM, Chromium
from tests.service.rooms import payload_at


class Site(AbstractContextManager):
    """One service on 127.0.0.1; `source` feeds it, `stop` and `start` take it away and back."""

    def __init__(self, **settings: Any) -> None:
        self._settings = Settings(http=HttpSettings(event_keepalive_s=0.5), **settings)
        with socket.create_server(("127.0.0.1", 0)) as probe:
            self.port = probe.getsockname()[1]
        self.url = f"http://127.0.0.1:{self.port}/"

    def __enter__(self) -> Self:
        self.start()
        return self

    def __exit__(self, *_: object) -> None:
        self.stop()

    def start(self) -> None:
        self.source = MemorySource()
        app = create_app(MapService(self._settings, Ports(self.source)))
        self.service: MapService = app.state.service
        config = uvicorn.Config(
            app, port=self.port, log_config=None, ws="none", timeout_graceful_shutdown=1
        )
        self._server = uvicorn.Server(config)
        self._thread = threading.Thread(target=lambda: asyncio.run(self._server.serve()))
        self._thread.start()
        with httpx.Client(transport=httpx.HTTPTransport(retries=20)) as client:
            while not client.get(f"{self.url}readyz").is_success:
                pass

    def stop(self) -> None:
        self.service.events.close()
        self._server.should_exit = True
        self._thread.join(30)

    def scan(self, x: float, y: float, seq: int, *, robot: str = "anna", **fields) -> None:
        self.source.put(robot, "laser", payload_at(x, y, seq=seq, **fields))

    def flush(self) -> None:
        httpx.post(f"{self.url}v1/flush", json={"timeout_s": 60}, timeout=90).raise_for_status()

    def ask(self, x: float, y: float) -> dict[str, list[float]]:
        return httpx.get(f"{self.url}v1/query", params={"x": x, "y": y}).raise_for_status().json()


@pytest.fixture(scope="session")
def browser() -> Iterator[Chromium]:
    if PROGRAM is None:
        pytest.skip("needs Chromium: `make browser` installs it where that is allowed")
    with Chromium() as browser:
        yield browser


@pytest.fixture
def page(browser: Chromium, site: Site) -> Iterator[Chromium]:
    """A page that must not complain; it is left before its service is."""
    browser.size(1200, 800)
    browser.system_theme("dark")
    browser.open("about:blank?")
    browser.problems.clear()
    browser.requests.clear()
    yield browser
    browser.open("about:blank?")
    assert browser.problems == []


@pytest.fixture
def site() -> Iterator[Site]:
    """A map of a square room with one robot, `anna`, in it."""
    with Site() as site:
        for seq in range(1, 5):
            site.scan(0.2 * seq, 0.1, seq)
        site.flush()
        yield site
