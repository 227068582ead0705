"""One contract for both HTTP clients, against a real socket."""

import asyncio
import json
import socket
from typing import Any

import numpy as np
import pytest

from clients.errors import (
    MapProtocolError,
    MapRequestError,
    MapServiceError,
    MapTimeoutError,
    MapUnavailableError,
    MapUnreachableError,
)
from clients.map_client import AsyncMapClient, MapClient
from gpom_core.errors import ConfigurationError, InvalidQueryError
from tests.clients.fake_http import npy, running_http_map

POINTS = np.array([[1.0, 2.0], [-3.0, 4.0], [5.5, -6.25]])


class Asker:
    """Calls a method of either client and gives what it returns or raises."""

    def __init__(self, kind: str, url: str) -> None:
        self.kind = kind
        self.url = url

    def __call__(self, method: str, *args: Any, timeout_s: float = 10.0, **kwargs: Any) -> Any:
        if self.kind == "blocking":
            with MapClient(self.url, timeout_s=timeout_s) as client:
                return getattr(client, method)(*args, **kwargs)

        async def ask() -> Any:
            async with AsyncMapClient(self.url, timeout_s=timeout_s) as client:
                return await getattr(client, method)(*args, **kwargs)

        return asyncio.run(ask())


@pytest.fixture(scope="module")
def server():
    with running_http_map() as fake:
        yield fake


@pytest.fixture
def fake(server):
    server.answers.clear()
    server.requests.clear()
    server.delay_s = 0.0
    return server


@pytest.fixture(params=["blocking", "asynchronous"])
def ask(request, fake):
    return Asker(request.param, fake.url)


def test_query_carries_points_and_version_as_npy(ask, fake):
    answer = ask("query", POINTS, fusion="rbcm")
    assert answer.map_version == 7
    np.testing.assert_array_equal(answer.mean, POINTS[:, 0])
    np.testing.assert_array_equal(answer.variance, POINTS[:, 1])
    np.testing.assert_array_equal(answer.occupancy, 0.5)
    np.testing.assert_array_equal(answer.known, [True, False, True])
    assert answer.known.dtype == np.bool_
    (request,) = fake.requests
    assert request["params"] == {"fusion": "rbcm"}
    assert request["headers"]["Content-Type"] == "application/x-npy"
    assert request["headers"]["Accept"] == "application/x-npy"


@pytest.mark.parametrize("points", [[[1, 2]], ((1.0, 2.0),), np.float32([[1, 2]]), POINTS.T[:2].T])
def test_query_takes_anything_like_an_array(ask, points):
    np.testing.assert_array_equal(ask("query", points).mean, np.asarray(points)[:, 0])


def test_query_takes_no_points(ask):
    assert ask("query", np.empty((0, 2))).occupancy.shape == (0,)


@pytest.mark.parametrize("points", [[1.0, 2.0], [[1, 2, 3]], [[1, 2], [3]], "points", [["a", "b"]]])
def test_query_refuses_other_shapes_before_asking(ask, fake, points):
    with pytest.raises(InvalidQueryError, match="points"):
        ask("query", points)
    assert not fake.requests


def test_one_point_keeps_every_digit(ask, fake):
    x, y = 0.1 + 0.2, -1e-17
    answer = ask("query_point", x, y)
    assert (answer.map_version, answer.occupancy, answer.mean, answer.variance, answer.known) == (
        7,
        0.5,
        x,
        y,
        True,
    )
    assert fake.requests[0]["params"]["fusion"] == "bcm"


@pytest.mark.parametrize("value", [0.25, [0.25]])
def test_one_point_may_come_as_a_list_of_one(ask, fake, value):
    known = [True] if isinstance(value, list) else True
    body = {"map_version": 9, "occupancy": value, "mean": value, "variance": value, "known": known}
    fake.answers["/v1/query"] = (200, "application/json", json.dumps(body).encode())
    answer = ask("query_point", 0, 0)
    assert (answer.occupancy, answer.known) == (0.25, True)


def test_grid_is_an_array_and_raster_a_file(ask, fake):
    grid = ask("grid", (0, -1, 2, 0.5), 0.5, layer="variance")
    np.testing.assert_array_equal(grid, np.arange(12.0).reshape(3, 4))
    assert fake.requests[0]["params"] == {
        "bbox": "0.0,-1.0,2.0,0.5",
        "resolution": "0.5",
        "layer": "variance",
        "format": "npy",
    }
    assert ask("raster", (0, 0, 1, 1), 0.1, file_format="nav2") == b"a nav2 of occupancy"
    with pytest.raises(InvalidQueryError, match="xmin, ymin, xmax, ymax"):
        ask("grid", (0, 1, 2), 0.5)


def test_status_experts_and_flush(ask, fake):
    status = ask("status")
    assert (status.map_version, status.scans_integrated, status.dirty_experts) == (7, 11, 1)
    assert status.bounds == (-1.0, -2.0, 3.0, 4.0)
    first, second = status.robots
    assert (first.id, first.lost, first.pose, first.alive) == ("r1", 2, (1.0, 2.0, 3.0), True)
    assert (second.pose, second.last_seen) == (None, None)
    assert status.details["news"] == "of a later version"
    assert ask("experts") == [{"cluster_id": 1}]
    assert ask("flush", 3.0).map_version == 7
    assert fake.requests[-1]["body"] == b'{"timeout_s":3.0}'


def test_flush_waits_longer_than_other_calls(ask, fake):
    fake.delay_s = 0.3
    assert ask("flush", 1.0, timeout_s=0.1).map_version == 7


def test_ready_or_not(ask, fake):
    assert ask("ready") is True
    fake.refuse("/readyz", 503, "Starting", "the journal is being replayed")
    assert ask("ready") is False


@pytest.mark.parametrize(
    ("status", "kind"), [(422, MapRequestError), (413, MapRequestError), (503, MapUnavailableError)]
)
def test_problem_details_become_errors(ask, fake, status, kind):
    fake.refuse("/v1/status", status, "Bad fusion", "expected bcm, rbcm or poe")
    with pytest.raises(kind) as caught:
        ask("status")
    error = caught.value
    assert (error.status, error.title, error.detail) == (
        status,
        "Bad fusion",
        "expected bcm, rbcm or poe",
    )
    assert str(error) == f"Bad fusion (HTTP {status}): expected bcm, rbcm or poe"


@pytest.mark.parametrize(
    "answer",
    [
        (404, "text/html", b"<html>another server</html>"),
        (500, "application/json", b"[1, 2]"),
        (200, "text/html", b"<html>another server</html>"),
        (200, "application/json", b"{}"),
        (200, "application/json", b"null"),
    ],
)
def test_another_kind_of_server_is_noticed(ask, fake, answer):
    fake.answers["/v1/status"] = answer
    with pytest.raises(MapProtocolError) as caught:
        ask("status")
    assert caught.value.status == answer[0]


@pytest.mark.parametrize(
    "content", [b"", b"junk", npy(np.zeros((3, 3))), npy(np.array([{}], dtype=object))]
)
def test_malformed_arrays_are_noticed(ask, fake, content):
    fake.answers["/v1/query"] = (200, "application/x-npy", content)
    with pytest.raises(MapProtocolError):
        ask("query", POINTS)


def test_slow_answers_time_out(ask, fake):
    fake.delay_s = 0.5
    with pytest.raises(MapTimeoutError, match="in time"):
        ask("status", timeout_s=0.05)


@pytest.mark.parametrize("kind", ["blocking", "asynchronous"])
def test_nobody_there_is_a_clear_error(kind):
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))  # bound, not listening: refuses
        ask = Asker(kind, f"http://127.0.0.1:{taken.getsockname()[1]}")
        with pytest.raises(MapUnreachableError, match="gpom serve") as caught:
            ask("status")
    assert caught.value.status is None
    assert isinstance(caught.value, MapServiceError)


@pytest.mark.parametrize("url", ["", "localhost:8080", "ftp://x", "http://", "http://h:x"])
@pytest.mark.parametrize("client", [MapClient, AsyncMapClient])
def test_malformed_addresses_are_refused(client, url):
    with pytest.raises(ConfigurationError, match="address"):
        client(url)
