import os
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from service.http.app import create_app
from service.journal import MemoryJournal
from service.map_service import MapService, Ports
from service.settings import Settings
from service.source import MemorySource
from tests.service.web import WebClient

COMPILE_S = 300.0  # when no kernel is in the cache yet


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    for item in items:
        if item.path.parent == Path(__file__).parent:
            item.add_marker(pytest.mark.timeout(COMPILE_S + 60.0))


@pytest.fixture(autouse=True)
def _no_settings_from_outside(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in [name for name in os.environ if name.startswith("GPOM_")]:
        if name != "GPOM_DATA":
            monkeypatch.delenv(name)


def wait_until(condition: Callable[[], bool], timeout_s: float = 60.0) -> None:
    end_s = time.monotonic() + timeout_s
    while not condition():
        assert time.monotonic() < end_s, "did not come true in time"
        time.sleep(0.005)


@pytest.fixture
def eventually() -> Callable[..., None]:
    return wait_until


@pytest.fixture
def source() -> MemorySource:
    return MemorySource()


@pytest.fixture
def journal() -> MemoryJournal:
    return MemoryJournal()


@pytest.fixture
def settings() -> Settings:
    return Settings()


@pytest.fixture
def service(
    settings: Settings, source: MemorySource, journal: MemoryJournal
) -> Iterator[MapService]:
    """The whole service without a network, warm."""
    service = MapService(settings, Ports(source, journal))
    service.start()
    try:
        wait_until(lambda: not service.troubles(), COMPILE_S)
        yield service
    finally:
        service.stop()


@pytest.fixture
def client(settings: Settings, source: MemorySource, journal: MemoryJournal) -> Iterator[WebClient]:
    """The web interface of the same, without a network."""
    app = create_app(MapService(settings, Ports(source, journal)))
    with WebClient(app) as client:
        wait_until(lambda: client.get("/readyz").is_success, COMPILE_S)
        yield client
