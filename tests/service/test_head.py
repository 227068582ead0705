"""HEAD is GET without the content, and what a route does not have is refused, not ignored."""

import pytest

from tests.service.rooms import payload_at
from tests.service.web import WebClient


@pytest.fixture
def mapped(client, source) -> WebClient:
    """A client of a service that has a map."""
    source.put("robot", "front", payload_at(seq=1))
    assert client.post("/v1/flush", json={"timeout_s": 60}).is_success
    return client


def _refusal(response) -> str:
    assert response.status_code == 422, response.text
    assert response.headers["content-type"] == "application/problem+json"
    return response.json()["detail"]


@pytest.mark.parametrize(
    "path",
    ["/healthz", "/readyz", "/metrics", "/v1/status", "/v1/query?x=0&y=0", "/v1/experts", "/",
     "/v1/grid?bbox=-1,-1,1,1", "/v1/tiles/occupancy/4/0/0.png", "/openapi.json",
     "/v1/query?x=no&y=0", "/nowhere"],
)  # fmt: skip
def test_head_is_get_without_the_content(mapped, path) -> None:
    head, get = mapped.request("HEAD", path), mapped.get(path)
    assert (head.status_code, head.content) == (get.status_code, b"")
    assert head.headers["content-type"] == get.headers["content-type"]
    if path != "/metrics":  # which counts the requests made meanwhile
        assert head.headers["content-length"] == get.headers["content-length"]


def test_head_of_an_endless_stream_ends(mapped) -> None:
    head = mapped.request("HEAD", "/v1/events")
    assert (head.status_code, head.content) == (200, b"")
    assert head.headers["content-type"].startswith("text/event-stream")
    counted = mapped.get("/metrics").text
    assert 'gpom_http_requests_total{method="HEAD",route="/v1/events",status="200"} 1.0' in counted
    assert "gpom_event_clients 0.0" in counted


def test_layers_that_are_not_there_are_refused(mapped) -> None:
    tile = _refusal(mapped.get("/v1/tiles/mean/4/0/0.png"))
    for word in ("layer", "occupancy", "variance", "state"):
        assert word in tile
    for layer in ("mean", "variance", "known"):
        nav2 = _refusal(mapped.get(f"/v1/grid?format=nav2&layer={layer}"))
        assert f"layer is {layer}" in nav2
