"""What one connection may make the service remember before anybody asks who it is."""

import asyncio
import math

import pytest
import uvicorn
from uvicorn.server import ServerState

from service.http.listening import HEAD_BYTES_MAX, Connection
from tests.service.test_bodies import run

PART = b"a" * 4096
TIMEOUT_S = 30.0
GET = b"GET / HTTP/1.1\r\nHost: a\r\n\r\n"
POST = b"POST / HTTP/1.1\r\nContent-Length: 100\r\n\r\n"


class Wire(asyncio.Transport):
    """Where the answers go."""

    def __init__(self) -> None:
        super().__init__()
        self.written, self.closed, self.closed_s = b"", False, math.inf

    def write(self, data: bytes) -> None:
        self.written += data

    def close(self) -> None:
        if not self.closed:
            self.closed, self.closed_s = True, asyncio.get_running_loop().time()

    def is_closing(self) -> bool:
        return self.closed

    def pause_reading(self) -> None: ...

    def resume_reading(self) -> None: ...


def opened(app) -> Connection:
    config = uvicorn.Config(app, log_config=None)
    return Connection(config, ServerState(), {}, head_timeout_s=TIMEOUT_S)


async def send(*parts: bytes) -> tuple[bytes, int]:
    """Send parts as long as the connection is open; what was answered, and how many it took."""

    async def answer(_scope, receive, send) -> None:
        while (await receive()).get("more_body"):
            pass
        await send({"type": "http.response.start", "status": 204, "headers": []})
        await send({"type": "http.response.body"})

    wire = Wire()
    connection = opened(answer)
    connection.connection_made(wire)
    taken = 0
    for part in parts:
        if wire.is_closing():
            break
        connection.data_received(part)
        await asyncio.sleep(0)
        taken += 1
    for _ in range(5):
        await asyncio.sleep(0)
    connection.connection_lost(None)
    await asyncio.sleep(0)
    return wire.written, taken


@pytest.mark.parametrize(
    "start",
    [
        pytest.param(b"GET /", id="target"),
        pytest.param(b"GET / HTTP/1.1\r\nA: ", id="header"),
        pytest.param(b"POST / HTTP/1.1\r\nTransfer-Encoding: chunked\r\n\r\n1;", id="extension"),
        pytest.param(
            b"POST / HTTP/1.1\r\nTransfer-Encoding: chunked\r\n\r\n0\r\nA: ", id="trailer"
        ),
    ],
)
def test_a_head_without_end_is_cut(start: bytes) -> None:
    answer, taken = asyncio.run(send(start, *[PART] * 100))
    assert taken <= HEAD_BYTES_MAX // len(PART) + 2
    assert answer.startswith(b"HTTP/1.1 400 ") == start.startswith(b"GET")


def test_what_is_long_and_has_an_end_passes() -> None:
    head = b"POST / HTTP/1.1\r\nA: " + PART * 8 + b"\r\nContent-Length: %d\r\n\r\n"
    body = [PART] * 100
    answer, taken = asyncio.run(send(head % (4096 * 100), *body, head % 0, head % 0))
    assert taken == 103
    assert answer.count(b"HTTP/1.1 204 ") == 3


async def hold(*steps: bytes | float, answer_s: float = 0.0) -> tuple[bytes, float]:
    """Send parts, with waits between them; what was answered, and when the connection was cut."""

    async def answer(_scope, _receive, send) -> None:
        await asyncio.sleep(answer_s)
        await send({"type": "http.response.start", "status": 204, "headers": []})
        await send({"type": "http.response.body"})

    wire, connection = Wire(), opened(answer)
    connection.connection_made(wire)
    for step in steps:
        if isinstance(step, float):
            await asyncio.sleep(step)
        elif not wire.is_closing():
            connection.data_received(step)
    await asyncio.sleep(answer_s + 100.0)
    connection.connection_lost(None)
    return wire.written, wire.closed_s


@pytest.mark.parametrize(
    ("steps", "cut_s", "status"),
    [
        pytest.param([], 30.0, None, id="nothing sent"),
        pytest.param([20.0, GET[:9]], 30.0, 408, id="half a head"),
        pytest.param([x for c in GET for x in (b"%c" % c, 2.0)], 30.0, 408, id="a drip"),
        pytest.param([20.0, GET, 3.0, GET[:9]], 53.0, 408, id="half a head after an answer"),
        pytest.param([POST, 3.0, b"x"], 33.0, None, id="a body that nobody reads"),
        pytest.param([POST, 3.0, b"x" * 100], 33.0, None, id="idle behind such a body"),
        pytest.param([20.0, GET], 25.0, None, id="idle after an answer"),
    ],
)
def test_a_connection_is_held_for_nobody_who_asks_nothing(steps, cut_s, status) -> None:
    answer, ended_s = run(hold(*steps))
    assert ended_s == pytest.approx(cut_s, abs=0.1)
    assert answer.count(b"HTTP/1.1 204 ") == sum(step in {GET, POST} for step in steps)
    assert answer.count(b"HTTP/1.1 408 ") == (status is not None)


@pytest.mark.parametrize(
    ("steps", "answer_s", "answers"),
    [
        pytest.param([GET], 100.0, 1, id="a long answer"),
        pytest.param([GET, 1.0, GET[:9]], 100.0, 1, id="half a head during one"),
        pytest.param([GET[:9], 29.0, GET[9:]], 0.0, 1, id="a slow head"),
        pytest.param([GET, 4.0] * 20, 0.0, 20, id="a question now and then"),
        pytest.param([POST, 3.0, b"x" * 50, 20.0, b"x" * 50, 20.0, GET], 0.0, 2, id="a late body"),
        pytest.param([GET, 2.0, GET[:9], 29.0, GET[9:]], 1.0, 2, id="a slow head after another"),
    ],
)
def test_who_asks_has_all_the_time_that_an_answer_takes(steps, answer_s, answers) -> None:
    answer, ended_s = run(hold(*steps, answer_s=answer_s))
    assert answer.count(b"HTTP/1.1 204 ") == answers
    waited_s = answer_s + sum(step for step in steps if isinstance(step, float))
    assert waited_s <= ended_s + 5.0, "not before it was told"
    assert b"HTTP/1.1 408 " not in answer
