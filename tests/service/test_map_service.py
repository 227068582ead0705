import io
import json
import threading
import time

import numpy as np
import pytest

from service.errors import SourceError
from service.http.app import create_app
from service.map_service import MapService, Ports
from service.points import JSON, NPY, write_npy
from service.settings import HttpSettings, IngestSettings, Settings, ZenohSettings
from service.source import MemorySource
from tests.service.rooms import HALF_M, payload_at
from tests.service.web import WebClient


def test_scans_become_a_map(service, source, journal) -> None:
    for seq in range(1, 11):
        source.put("robot", "front", payload_at(0.1 * seq, 0.05 * seq, seq=seq))
    service.flush().result(60.0)
    state = service.state
    assert state.scans_integrated == len(journal.records) == 10
    wall, inside, outside = state.snapshot.query([[HALF_M, 0.3], [0.5, 0.5], [50.0, 0.0]]).occupancy
    assert inside < 0.2 < 0.7 < wall
    assert outside == pytest.approx(0.5)
    (robot,) = service.fleet.robots()
    assert (robot.scans, robot.lost) == (10, 0)


@pytest.mark.parametrize("media_type", [JSON, NPY])
def test_remote_queries_answer_in_kind(service, source, media_type) -> None:
    source.put("robot", "front", payload_at())
    service.flush().result(60.0)
    points = np.array([[0.0, 0.0], [2.0, 1.0]])
    body = write_npy(points) if media_type == NPY else json.dumps({"points": points.tolist()})
    body = body if isinstance(body, bytes) else body.encode()
    reply = source.ask(body, media_type).result(10.0)
    assert not reply.is_error
    assert reply.media_type == media_type
    expected = service.state.snapshot.query(points)
    if media_type == NPY:
        np.testing.assert_allclose(np.load(io.BytesIO(reply.body))[:, 0], expected.occupancy)
    else:
        answer = json.loads(reply.body)
        np.testing.assert_allclose(answer["variance"], expected.variance)
        assert answer["map_version"] == service.state.snapshot.version


@pytest.mark.parametrize(
    ("body", "media_type", "fusion", "status"),
    [
        (b"", JSON, None, 422),
        (b"", "", None, 415),
        (write_npy(np.array([[np.nan, 0.0]])), NPY, None, 422),
        (write_npy(np.zeros((1, 2))), NPY, "best", 422),
    ],
)
def test_remote_queries_are_refused_with_the_problem(
    service, source, body, media_type, fusion, status
) -> None:
    reply = source.ask(body, media_type, fusion).result(10.0)
    assert reply.is_error
    assert json.loads(reply.body)["status"] == status


def test_remote_queries_never_hang(service, source, monkeypatch) -> None:
    def break_down(*_) -> None:
        raise ZeroDivisionError

    monkeypatch.setattr("service.remote_desk.predict", break_down)
    reply = source.ask(b'{"points": []}', JSON).result(10.0)
    assert reply.is_error
    assert json.loads(reply.body)["status"] == 500


def test_remote_queries_beyond_capacity_are_told_so(source) -> None:
    http = HttpSettings(query_threads=1, queries_waiting_max=0)
    service = MapService(Settings(http=http), Ports(source))
    service.start()
    release = threading.Event()
    try:
        service.queries.submit(release.wait)
        reply = source.ask(b'{"points": []}', JSON).result(10.0)
        problem = json.loads(reply.body)
        assert (problem["status"], problem["retry_after_s"]) == (503, 1)
    finally:
        release.set()
        service.stop()


def test_remote_queries_beyond_their_share_are_told_so_and_others_have_room(source) -> None:
    http = HttpSettings(query_threads=1, queries_waiting_max=8, retry_after_s=3)
    service = MapService(Settings(http=http, zenoh=ZenohSettings(queries_max=2)), Ports(source))
    service.start()
    release = threading.Event()
    try:
        service.queries.submit(release.wait)
        waiting = [source.ask(b'{"points": []}', JSON) for _ in range(2)]
        for _ in range(3):
            reply = source.ask(b'{"points": []}', JSON).result(10.0)
            problem = json.loads(reply.body)
            assert reply.is_error
            assert (problem["status"], problem["allowed"], problem["retry_after_s"]) == (429, 2, 3)
            assert "zenoh.queries_max" in problem["detail"]
        by_http = service.queries.submit(lambda: "answered")
        release.set()
        assert by_http.result(10.0) == "answered"
        assert [one.result(10.0).is_error for one in waiting] == [False, False]
        assert not source.ask(b'{"points": []}', JSON).result(10.0).is_error
    finally:
        release.set()
        service.stop()


def test_a_remote_query_that_is_too_long_is_refused_before_it_is_read(source) -> None:
    service = MapService(Settings(http=HttpSettings(body_bytes_max=1024)), Ports(source))
    service.start()
    try:
        problem = json.loads(source.ask(b"[" * 1025, JSON).result(10.0).body)
        assert problem["status"] == 413
        assert "1024" in problem["detail"]
    finally:
        service.stop()


def test_robots_come_and_go(service, source) -> None:
    source.set_alive("robot", True)
    assert service.fleet.robots()[0].alive
    source.set_alive("robot", False)
    assert not service.fleet.robots()[0].alive


def test_troubles_are_told(service, source) -> None:
    assert service.troubles() == []
    source.close()
    assert service.troubles() == ["the in-memory source is closed"]
    service.stop()
    assert len(service.troubles()) == 3


def test_stopping_twice_is_harmless(service) -> None:
    service.stop()
    service.stop()


def test_a_source_that_cannot_be_opened_leaves_nothing_running() -> None:
    class Broken(MemorySource):
        def open(self, sink) -> None:
            raise SourceError("port is taken")

    before = threading.active_count()
    service = MapService(Settings(), Ports(Broken()))
    with pytest.raises(SourceError):
        service.start()
    end_s = time.monotonic() + 10.0
    while threading.active_count() > before and time.monotonic() < end_s:
        time.sleep(0.01)
    assert threading.active_count() <= before


@pytest.mark.parametrize("policy", ["block", "drop_oldest", "drop_newest"])
def test_overload_ends_as_its_policy_says_and_is_counted(source, policy, monkeypatch) -> None:
    ingest = IngestSettings(
        policy=policy, queue_scans_max=4, backlog_scans_max=1, batch_scans_max=1
    )
    service = MapService(Settings(ingest=ingest), Ports(source))
    update = service._mapping._mapper.update

    def slowly(scan):
        time.sleep(0.01)
        return update(scan)

    monkeypatch.setattr(service._mapping._mapper, "update", slowly)
    service.start()
    try:
        for seq in range(1, 31):
            source.put("robot", "front", payload_at(seq=seq))
        service.flush().result(60.0)
        integrated, dropped = service.state.scans_integrated, service._ingest.queue.dropped
        assert integrated + dropped == service.scans_received == 30
        assert (dropped == 0) == (policy == "block")
        exposition = service.metrics.exposition().decode()
        assert f"gpom_scans_dropped_total {dropped}.0" in exposition
    finally:
        service.stop()


def test_stopping_releases_a_robot_that_is_blocked(source, monkeypatch) -> None:
    ingest = IngestSettings(queue_scans_max=1, backlog_scans_max=1, batch_scans_max=1)
    service = MapService(Settings(ingest=ingest), Ports(source))
    monkeypatch.setattr(
        service._mapping._mapper,
        "update",
        lambda scan: time.sleep(0.2),  # far too slow
    )
    service.start()

    def drive() -> None:
        for seq in range(1, 200):
            service.on_scan("robot", "front", payload_at(seq=seq))

    robot = threading.Thread(target=drive)
    robot.start()
    time.sleep(0.2)
    start_s = time.monotonic()
    service.stop()
    assert time.monotonic() - start_s < 5.0
    robot.join(5.0)
    assert not robot.is_alive()


def test_two_services_in_one_process_do_not_meet() -> None:
    first, second = MemorySource(), MemorySource()
    with (
        WebClient(create_app(MapService(Settings(), Ports(first)))) as one,
        WebClient(create_app(MapService(Settings(), Ports(second)))) as two,
    ):
        first.put("robot", "front", payload_at())
        one.post("/v1/flush")
        two.post("/v1/flush")
        assert one.get("/v1/status").json()["scans_integrated"] == 1
        assert two.get("/v1/status").json()["scans_integrated"] == 0
