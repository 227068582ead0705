import json
import struct
import threading
import time

import pytest
import zenoh

from service.errors import SourceError
from service.points import JSON
from service.sequences import Cursor, SensorKey
from service.settings import ZenohSettings
from service.source import RemoteReply
from service.zenoh_source import ZenohSource
from tests.service.fleet_link import locator, open_session

LOCAL = ("tcp/127.0.0.1:0",)
PREFIX = "gpom/v1/site"


class Sink:
    """Writes down what arrives, and answers every query."""

    def __init__(self) -> None:
        self.scans = []
        self.presence = []
        self.queries = []
        self.refused = []

    def on_scan(self, robot, sensor, payload) -> None:
        if payload == b"bomb":
            raise ZeroDivisionError
        self.scans.append((robot, sensor, payload))

    def on_refused(self, reason, count) -> None:
        self.refused.append((reason, count))

    def cursor(self, robot, sensor):
        return Cursor(2**63 + 7, 2**64 - 1) if sensor == "front" else None

    def on_presence(self, robot, alive) -> None:
        self.presence.append((robot, alive))

    def on_query(self, query) -> None:
        self.queries.append(query)
        if query.body == b"bomb":
            raise ZeroDivisionError
        failed = query.body == b"no"
        reply = RemoteReply(query.body[::-1], query.media_type, is_error=failed)
        threading.Thread(target=query.reply, args=(reply,)).start()


@pytest.fixture
def sink() -> Sink:
    return Sink()


@pytest.fixture
def source(sink):
    source = ZenohSource(ZenohSettings(listen=LOCAL))
    source.open(sink)
    yield source
    source.close()


@pytest.fixture
def robot(source):
    (endpoint,) = source.endpoints()
    with open_session(connect=endpoint) as session:
        yield session


@pytest.mark.parametrize(
    "key", [f"{PREFIX}/*/scan/front", f"{PREFIX}/a$*/scan/front", f"{PREFIX}/**", "**"]
)
def test_a_put_to_many_is_of_no_robot(key, robot, sink, eventually, caplog) -> None:
    """Stored for a robot named `*`, it would be acknowledged to all of them."""
    robot.put(key, b"for all")
    robot.put(f"{PREFIX}/r2/scan/front", b"mine")
    eventually(lambda: len(sink.scans) == 1)
    assert sink.scans == [("r2", "front", b"mine")]
    assert sink.refused == [("bad_key", 1)]
    replies = [reply for reply in robot.get(key, timeout=5.0) if reply.ok is not None]
    assert not [reply for reply in replies if "/cursor/" in str(reply.ok.key_expr)]
    assert "failed" not in caplog.text


def test_scans_arrive_with_robot_and_sensor(robot, sink, eventually) -> None:
    for payload in (b"\x00\x01", b"bomb", b"after the bomb"):
        robot.put(f"{PREFIX}/r2/scan/front", payload)
    robot.put(f"{PREFIX}/_map/scan/front", b"not a robot")
    robot.put(f"{PREFIX}/r2/scan/front/raw", b"too deep")
    robot.put(f"{PREFIX}/r2/scan/rear", b"last")
    eventually(lambda: len(sink.scans) == 3)
    assert sink.scans == [
        ("r2", "front", b"\x00\x01"),
        ("r2", "front", b"after the bomb"),
        ("r2", "rear", b"last"),
    ]


def test_robots_are_seen_to_come_and_go(robot, sink, eventually) -> None:
    token = robot.liveliness().declare_token(f"{PREFIX}/r2/alive")
    eventually(lambda: sink.presence == [("r2", True)])
    token.undeclare()
    eventually(lambda: sink.presence == [("r2", True), ("r2", False)])


def test_the_service_is_seen_to_be_alive(source, robot) -> None:
    replies = [reply.ok for reply in robot.liveliness().get(f"{PREFIX}/_map/alive", timeout=5.0)]
    assert [str(sample.key_expr) for sample in replies] == [f"{PREFIX}/_map/alive"]
    source.close()
    end_s = time.monotonic() + 5.0
    while list(robot.liveliness().get(f"{PREFIX}/_map/alive", timeout=1.0)):
        assert time.monotonic() < end_s


def _ask(session, body, **options):
    replies = session.get(
        f"{PREFIX}/_map/query{options.pop('parameters', '')}",
        payload=body,
        encoding=options.pop("encoding", JSON),
        consolidation=zenoh.ConsolidationMode.NONE,
        timeout=10.0,
        **options,
    )
    return list(replies)


def test_queries_are_answered_refused_and_never_hang(robot, sink) -> None:
    start_s = time.monotonic()
    (reply,) = _ask(robot, b"abc", parameters="?fusion=rbcm")
    assert reply.ok.payload.to_bytes() == b"cba"
    assert str(reply.ok.encoding) == JSON
    (reply,) = _ask(robot, b"abc", encoding="Application/JSON; charset=utf-8")
    assert str(reply.ok.encoding) == JSON
    (reply,) = _ask(robot, b"no")
    assert reply.err.payload.to_bytes() == b"on"
    (reply,) = _ask(robot, b"bomb")
    assert json.loads(reply.err.payload.to_bytes())["status"] == 500
    assert time.monotonic() - start_s < 9.0, "none waited for its timeout"
    assert [query.fusion for query in sink.queries] == ["rbcm", None, None, None]
    assert sink.queries[0].media_type == JSON


def test_robots_are_told_what_is_stored_and_may_ask(source, robot) -> None:
    acks = robot.declare_subscriber(f"{PREFIX}/r2/ack/*")
    list(robot.get(f"{PREFIX}/r2/cursor/front"))  # the subscription is known by now
    source.acknowledge({SensorKey("r2", "front"): Cursor(7, 8), SensorKey("r3", "x"): Cursor(1, 1)})
    sample = acks.recv()
    assert str(sample.key_expr) == f"{PREFIX}/r2/ack/front"
    assert sample.payload.to_bytes() == (7).to_bytes(8, "little") + (8).to_bytes(8, "little")
    replies = {
        sensor: [r.ok.payload.to_bytes() for r in robot.get(f"{PREFIX}/r2/cursor/{sensor}")]
        for sensor in ("front", "rear", "*")
    }
    assert replies["front"] == [struct.pack("<QQ", 2**63 + 7, 2**64 - 1)]
    assert replies["rear"] == [b""], "not known is an answer, and not silence"
    assert replies["*"] == []


def test_a_taken_port_is_told(source) -> None:
    (endpoint,) = source.endpoints()
    with pytest.raises(SourceError, match="in use"):
        ZenohSource(ZenohSettings(listen=(endpoint,))).open(Sink())


def test_bad_options_are_told() -> None:
    with pytest.raises(SourceError, match="no/such/path"):
        ZenohSource(ZenohSettings(listen=(), options={"no/such/path": 1})).open(Sink())


def test_closed_means_trouble(source) -> None:
    assert source.trouble() is None
    source.close()
    assert "closed" in source.trouble()
    source.close()


def test_a_router_may_come_later(sink, eventually) -> None:
    with open_session(mode="peer") as placeholder:
        endpoint = locator(placeholder, "peer")
    source = ZenohSource(
        ZenohSettings(
            listen=(), connect=(endpoint,), options={"connect/retry": {"period_init_ms": 100}}
        )
    )
    source.open(sink)
    try:
        assert endpoint in source.trouble()
        config = zenoh.Config()
        for path, value in {
            "mode": "router",
            "listen/endpoints": [endpoint],
            "scouting/multicast/enabled": False,
            "scouting/gossip/enabled": False,
            "transport/shared_memory/enabled": False,
        }.items():
            config.insert_json5(path, json.dumps(value))
        with zenoh.open(config), open_session(connect=endpoint) as robot:
            eventually(lambda: source.trouble() is None)
            eventually(lambda: list(robot.liveliness().get(f"{PREFIX}/_map/alive", timeout=1.0)))
            robot.put(f"{PREFIX}/r2/scan/front", b"through the router")
            eventually(lambda: bool(sink.scans))
        eventually(lambda: source.trouble() is not None)
    finally:
        source.close()
