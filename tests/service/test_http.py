import io
import json
import re
import threading
import zipfile

import numpy as np
import pytest
from PIL import Image

from service.http.app import create_app
from service.http.context import VERSION_HEADER
from service.map_service import MapService, Ports
from service.points import JSON, NPY, write_npy
from service.settings import HttpSettings, Settings
from service.source import MemorySource
from tests.service.rooms import payload_at
from tests.service.web import WebClient

POINTS = [[1.5, 1.0], [3.0, 0.5], [80.0, 80.0]]


@pytest.fixture
def settings() -> Settings:
    return Settings(
        http=HttpSettings(query_points_max=100, grid_cells_max=10_000, body_bytes_max=4096)
    )


@pytest.fixture
def mapped(client, source) -> WebClient:
    """A client of a service that has a map."""
    for seq in range(1, 6):
        source.put("robot", "front", payload_at(0.1 * seq, 0.05 * seq, seq=seq))
    assert client.post("/v1/flush", json={"timeout_s": 60}).is_success
    return client


def _problem(response, status: int) -> dict:
    assert response.status_code == status, response.text
    assert response.headers["content-type"] == "application/problem+json"
    problem = response.json()
    assert problem["status"] == status
    assert all(problem[name] for name in ("type", "title", "detail"))
    return problem


def _npy(response) -> np.ndarray:
    assert response.headers["content-type"] == NPY
    return np.load(io.BytesIO(response.content))


def test_json_query(mapped) -> None:
    response = mapped.post("/v1/query", json={"points": POINTS})
    assert response.headers["content-type"] == JSON
    answer = response.json()
    assert list(answer) == ["map_version", "occupancy", "mean", "variance", "known"]
    assert response.headers[VERSION_HEADER] == str(answer["map_version"])
    assert answer["occupancy"][0] < 0.3 < 0.7 < answer["occupancy"][1]
    assert answer["occupancy"][2] == pytest.approx(0.5)
    assert answer["variance"][2] == pytest.approx(1.0)
    assert answer["known"] == [True, True, False]


def test_all_forms_and_ways_say_the_same(mapped) -> None:
    by_json = mapped.post("/v1/query", json={"points": POINTS}).json()
    body = write_npy(np.array(POINTS))
    by_npy = _npy(mapped.post("/v1/query", content=body, headers={"content-type": NPY}))
    mixed = mapped.post("/v1/query", json={"points": POINTS}, headers={"accept": NPY})
    np.testing.assert_array_equal(by_npy, _npy(mixed))
    for column, name in enumerate(("occupancy", "mean", "variance", "known")):
        np.testing.assert_array_equal(by_npy[:, column], by_json[name])
    one = mapped.get("/v1/query", params={"x": 3.0, "y": 0.5})
    assert one.json()["occupancy"] == [by_json["occupancy"][1]]
    assert VERSION_HEADER in one.headers


def test_fusion_rules_are_passed_on(mapped) -> None:
    answers = {
        rule: mapped.get("/v1/query", params={"x": 80, "y": 80, "fusion": rule}).json()["variance"]
        for rule in ("bcm", "rbcm", "poe")
    }
    assert answers["bcm"] == answers["rbcm"]
    assert answers["poe"][0] < 0.5, "the paper's printed rule is sure where nothing was seen"


def test_no_points_is_an_answer(mapped) -> None:
    assert mapped.post("/v1/query", json={"points": []}).json()["occupancy"] == []


@pytest.mark.parametrize(
    ("accept", "expected"),
    [
        (JSON, JSON),
        (NPY, NPY),
        ("*/*", JSON),
        ("application/*", JSON),
        ("text/html, application/x-npy;q=0.5", NPY),
        ("application/json;q=0.1, application/x-npy", NPY),
        ("*/*, application/json;q=0", NPY),
        ("text/html", None),
        ("application/json;q=0, application/x-npy;q=x", None),
        (["text/html", NPY], NPY),
        ([f"{JSON};q=0.5", "", f"text/html, {NPY};q=0.6"], NPY),
        (["", ""], JSON),
    ],
)
def test_negotiation(client, accept, expected) -> None:
    lines = [accept] if isinstance(accept, str) else accept
    headers = [("accept", line) for line in lines]
    response = client.get("/v1/query", params={"x": 0, "y": 0}, headers=headers)
    if expected is None:
        _problem(response, 406)
    else:
        assert response.headers["content-type"] == expected


@pytest.mark.parametrize(
    ("options", "status", "words"),
    [
        ({"content": b"{}", "headers": {"content-type": "text/plain"}}, 415, "application/x-npy"),
        ({"content": b"{}"}, 415, "missing"),
        ({"content": b"{", "headers": {"content-type": JSON}}, 422, "no JSON"),
        ({"json": {}}, 422, "points"),
        ({"json": {"points": [[1, 2]], "fusion": "best"}}, 422, "fusion"),
        ({"json": {"points": [[1, 2]]}, "params": {"fusion": "best"}}, 422, "fusion"),
        ({"json": {"points": [[1, 2]] * 101}}, 413, "at most 100"),
        ({"content": b" " * 5000, "headers": {"content-type": JSON}}, 413, "4096 bytes"),
        (
            {"content": b'{"points": [[NaN, 1]]}', "headers": {"content-type": JSON}},
            422,
            "finite",
        ),
        (
            {"content": b'{"points": [[1e400, 1]]}', "headers": {"content-type": JSON}},
            422,
            "finite",
        ),
        (
            {"content": write_npy(np.array([[np.inf, 1]])), "headers": {"content-type": NPY}},
            422,
            "finite",
        ),
        ({"content": b"x", "headers": {"content-type": NPY}}, 422, "npy"),
    ],
)
def test_bad_queries(client, options, status, words) -> None:
    assert words in _problem(client.post("/v1/query", **options), status)["detail"]


def test_bodies_of_unstated_length_are_bounded_too(client) -> None:
    async def endless():
        for _ in range(100):
            yield b" " * 1000

    response = client.post("/v1/query", content=endless(), headers={"content-type": JSON})
    _problem(response, 413)


@pytest.mark.parametrize(
    "path",
    [
        "/v1/query?x=1",
        "/v1/query?x=nan&y=1",
        "/v1/query?x=1&y=inf",
        "/v1/query?x=1&y=east",
        "/v1/grid",
        "/v1/grid?bbox=1,2,3",
        "/v1/grid?bbox=a,b,c,d",
        "/v1/grid?bbox=0,0,0,1",
        "/v1/grid?bbox=0,0,-1,1",
        "/v1/grid?bbox=0,0,nan,1",
        "/v1/grid?bbox=0,0,1,inf",
        "/v1/grid?bbox=0,0,1,1&resolution=0",
        "/v1/grid?bbox=0,0,1,1&resolution=-1",
        "/v1/grid?bbox=0,0,5000,5000&resolution=-0.01",
        "/v1/grid?bbox=5000,5000,0,0&resolution=0.01",
        "/v1/grid?bbox=0,0,1,1&resolution=nan",
        "/v1/grid?bbox=0,0,1,1&layer=height",
        "/v1/grid?bbox=0,0,1,1&format=bmp",
        "/v1/grid?bbox=0,0,1,1&fusion=best",
    ],
)
def test_bad_parameters(client, path) -> None:
    _problem(client.get(path), 422)


def test_too_many_cells_say_what_is_allowed(client) -> None:
    response = client.get("/v1/grid?bbox=0,0,100,100&resolution=0.5")
    detail = _problem(response, 413)["detail"]
    assert "at most 10000" in detail
    resolution = float(re.search(r"resolution from ([\d.]+) m", detail).group(1))
    assert client.get(f"/v1/grid?bbox=0,0,100,100&resolution={resolution}").is_success
    assert client.get("/v1/grid?bbox=0,0,1e300,1e300&resolution=1e-300").status_code in {413, 422}
    far_too_many = client.get("/v1/grid?bbox=0,0,5000,5000&resolution=0.01")
    assert "500000 x 500000 cells; at most 10000" in _problem(far_too_many, 413)["detail"]


def test_grid_npy_is_the_query_at_cell_centres(mapped) -> None:
    url = "/v1/grid?bbox=-1,2,2,4&resolution=0.5&format=npy"
    for layer in ("occupancy", "mean", "variance", "known"):
        grid = _npy(mapped.get(f"{url}&layer={layer}"))
        assert grid.shape == (4, 6)
        assert grid.dtype == np.float64
        centre = {"x": -1 + 0.25 + 0.5 * 2, "y": 2 + 0.25 + 0.5 * 1}
        answer = mapped.get("/v1/query", params=centre).json()
        assert grid[1, 2] == pytest.approx(float(answer[layer][0]), abs=1e-12)


def test_a_grid_may_be_of_the_version_before(mapped, source) -> None:
    url = "/v1/grid?bbox=-5,-4,5,4&resolution=0.1&format=npy"
    before = mapped.get(url)
    source.put("robot", "front", payload_at(10.0, 0.0, seq=6, room=(10.0, 0.0)))
    version = mapped.post("/v1/flush", json={"timeout_s": 60}).json()["map_version"]
    at_once = mapped.get(f"{url}&max_age_s=60")
    assert at_once.content == before.content
    assert at_once.headers[VERSION_HEADER] == before.headers[VERSION_HEADER]
    assert mapped.get(url).headers[VERSION_HEADER] == str(version)
    assert mapped.get(f"{url}&max_age_s=60").headers[VERSION_HEADER] == str(version)
    _problem(mapped.get(f"{url}&max_age_s=-1"), 422)


def test_grid_png_shows_the_room(mapped) -> None:
    response = mapped.get("/v1/grid?bbox=-5,-4,5,4&resolution=0.1")
    assert response.headers["content-type"] == "image/png"
    assert VERSION_HEADER in response.headers
    picture = np.asarray(Image.open(io.BytesIO(response.content)).convert("RGB")).astype(int)
    assert picture.shape == (80, 100, 3)
    assert picture[30, 65].min() > 200, "free inside"
    assert picture[2, 2].max() - picture[2, 2].min() > 10, "unknown is no gray"
    assert picture[40, 79:82].min() < 60, "a wall to the east"


def test_grid_without_a_box_is_the_whole_map(mapped) -> None:
    bounds = mapped.get("/v1/status").json()["bounds"]
    picture = Image.open(io.BytesIO(mapped.get("/v1/grid?resolution=0.1").content))
    assert picture.width == np.ceil((bounds[2] - bounds[0]) / 0.1 - 1e-9)


def test_grid_for_nav2(mapped) -> None:
    response = mapped.get("/v1/grid?bbox=-4,-4,4,4&format=nav2")
    assert response.headers["content-type"] == "application/zip"
    with zipfile.ZipFile(io.BytesIO(response.content)) as files:
        assert sorted(files.namelist()) == ["map.pgm", "map.yaml", "variance.pgm", "variance.yaml"]


def test_status_of_an_empty_map(client) -> None:
    assert client.get("/v1/status").json() == {
        "map_version": 0,
        "scans_received": 0,
        "scans_integrated": 0,
        "experts": 0,
        "dirty_experts": 0,
        "observations": 0,
        "robots": [],
        "bounds": None,
        "experts_out_of_bounds": 0,
    }


def test_status_of_a_map(mapped, source) -> None:
    source.set_alive("robot", True)
    source.put("robot", "front", b"rubbish")
    source.put("robot", "front", payload_at(1.0, -1.0, seq=9))
    status = mapped.post("/v1/flush").json()
    assert status == mapped.get("/v1/status").json()
    assert status["scans_received"] == 7
    assert status["scans_integrated"] == 6
    assert status["dirty_experts"] == 0
    assert status["experts"] > 0
    assert status["observations"] > 0
    xmin, ymin, xmax, ymax = status["bounds"]
    assert xmin < -2.9 < 2.9 < xmax
    assert ymin < -2.9 < 2.9 < ymax
    (robot,) = status["robots"]
    assert robot.pop("last_seen") > 1e9
    assert (robot.pop("intake"), robot.pop("refused")) == (None, {"truncated": 1})
    assert robot == {"id": "robot", "scans": 6, "lost": 3, "pose": [1.0, -1.0, 0.0], "alive": True}


def test_experts(mapped) -> None:
    answer = mapped.get("/v1/experts").json()
    assert answer["map_version"] > 0
    assert answer["quarantined"] == []
    assert len(answer["experts"]) == mapped.get("/v1/status").json()["experts"]
    expert = answer["experts"][0]
    assert len(expert["line"]) == 2
    assert expert["length_scale_m"] > 0.0
    assert not expert["dirty"]


@pytest.mark.parametrize(
    "body", [{"timeout_s": 0}, {"timeout_s": -1}, {"timeout_s": 1e9}, {"timeout": 1}, [1]]
)
def test_bad_flushes(client, body) -> None:
    _problem(client.post("/v1/flush", json=body), 422)


def test_flush_that_takes_too_long(client, source, monkeypatch) -> None:
    keeper = client.app.state.service._mapping
    monkeypatch.setattr(keeper._training, "step", lambda: None)
    source.put("robot", "front", payload_at())
    detail = _problem(client.post("/v1/flush", json={"timeout_s": 0.3}), 504)["detail"]
    assert "not trained" in detail


def test_health(client, source) -> None:
    assert client.get("/healthz").json() == {"status": "ok"}
    assert client.get("/readyz").json() == {"status": "ok"}
    source.close()
    problem = _problem(client.get("/readyz"), 503)
    assert problem["troubles"] == ["the in-memory source is closed"]
    assert client.get("/healthz").is_success


def test_metrics(mapped) -> None:
    mapped.get("/v1/query?x=1&y=1")
    mapped.get("/no/such/thing")
    text = mapped.get("/metrics").text
    for name in ("scans_integrated_total", "scans_received_total", "scan_lag_seconds_count"):
        assert f"gpom_{name} 5.0" in text
    request = 'gpom_http_requests_total{method="GET",route="/v1/query",status="200"} 1.0'
    assert request in text
    assert 'route="none",status="404"' in text
    samples = [line for line in text.splitlines() if line and not line.startswith("#")]
    assert all(line.startswith("gpom_") for line in samples)


def test_unknown_paths_and_methods(client) -> None:
    _problem(client.get("/v1/nothing"), 404)
    response = client.request("DELETE", "/v1/query")
    _problem(response, 405)
    assert response.headers["allow"] == "GET, HEAD, POST"


def test_unexpected_errors(client, monkeypatch) -> None:
    def break_down(*_):
        raise ZeroDivisionError("secret")

    monkeypatch.setattr("service.http.queries.predict", break_down)
    response = client.post("/v1/query", json={"points": []})
    assert "secret" not in json.dumps(_problem(response, 500))


def test_busy_service_says_when_to_come_back() -> None:
    http = HttpSettings(query_threads=1, queries_waiting_max=0, retry_after_s=3)
    app = create_app(MapService(Settings(http=http), Ports(MemorySource())))
    with WebClient(app) as client:
        release = threading.Event()
        app.state.service.queries.submit(release.wait)
        try:
            for response in (
                client.post("/v1/query", json={"points": [[0, 0]]}),
                client.get("/v1/grid?bbox=0,0,1,1"),
            ):
                _problem(response, 503)
                assert response.headers["retry-after"] == "3"
            assert client.get("/v1/query?x=0&y=0").is_success, "one point is always answered"
        finally:
            release.set()


def test_openapi_is_served_with_examples(client) -> None:
    schema = client.get("/openapi.json").json()
    for path in (
        "/v1/query",
        "/v1/grid",
        "/v1/status",
        "/v1/experts",
        "/v1/flush",
        "/v1/events",
        "/healthz",
        "/readyz",
        "/metrics",
    ):
        for operation in schema["paths"][path].values():
            problem = operation["responses"]["default"]["content"]["application/problem+json"]
            assert problem["schema"]["$ref"].endswith("ProblemDetails")
            assert "HTTPValidationError" not in json.dumps(operation)
    assert "ProblemDetails" in schema["components"]["schemas"]
    post = schema["paths"]["/v1/query"]["post"]
    assert "example" in post["requestBody"]["content"][JSON]
    assert "example" in post["responses"]["200"]["content"][JSON]
    told = {tag["name"] for tag in schema["tags"]}
    assert all(tag["description"] for tag in schema["tags"])
    used = set()
    for path, operations in schema["paths"].items():
        for operation in operations.values():
            used |= set(operation["tags"])
            assert len(operation["summary"].split()) > 2, path
            assert all(p["description"] for p in operation.get("parameters", [])), path
            assert operation["responses"]["200"]["description"] != "Successful Response", path
    assert used == told
    assert "security" not in schema, "nobody needs a token here"
    missing = set(re.findall(r'"#/components/schemas/(\w+)"', json.dumps(schema)))
    assert missing <= schema["components"]["schemas"].keys()
