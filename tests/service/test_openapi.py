"""Whatever a client that read the OpenAPI sends, no route fails: schemathesis sends it."""

import threading
import time

import pytest
import uvicorn
from hypothesis import HealthCheck, given, settings

from service.http.app import create_app
from service.map_service import MapService, Ports
from service.settings import HttpSettings, Settings
from service.source import MemorySource
from tests.service.rooms import payload_at

schemathesis = pytest.importorskip("schemathesis", reason="schemathesis is not installed")

pytestmark = pytest.mark.filterwarnings("ignore")  # those of schemathesis and what it brings


@pytest.fixture(scope="module")
def api():
    """The routes of a service with a small map; streams, which never end, are tested elsewhere."""
    source = MemorySource()
    limits = HttpSettings(grid_cells_max=10_000, query_points_max=1000, flush_timeout_max_s=5.0)
    app = create_app(MapService(Settings(http=limits), Ports(source)))
    service = app.state.service
    service.start()
    source.put("robot", "front", payload_at())
    service.flush().result(300.0)
    server = uvicorn.Server(uvicorn.Config(app, port=0, lifespan="off", log_config=None))
    thread = threading.Thread(target=server.run)
    thread.start()
    while not server.started:
        time.sleep(0.01)
    port = server.servers[0].sockets[0].getsockname()[1]
    url = f"http://127.0.0.1:{port}/openapi.json"
    yield schemathesis.openapi.from_url(url).exclude(path="/v1/events")
    server.should_exit = True
    thread.join()
    service.stop()


def hold(operation) -> int:
    """Make requests of one operation; how many."""
    made = 0

    @settings(
        max_examples=25, deadline=None, database=None, suppress_health_check=list(HealthCheck)
    )
    @given(operation.as_strategy())
    def no_request_makes_it_fail(case) -> None:
        nonlocal made
        made += 1
        response = case.call()
        status = response.status_code
        assert status < 500 or status in {503, 504}, (case.as_curl_command(), response.text)
        if status >= 400:
            assert response.headers["content-type"][0] == "application/problem+json"

    no_request_makes_it_fail()
    return made


def test_no_request_makes_a_route_fail(api) -> None:
    operations = [result.ok() for result in api.get_all_operations()]
    assert len(operations) >= 8
    for operation in operations:
        assert hold(operation) >= 1, operation.label
