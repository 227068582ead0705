"""What one connection may make the service remember before anybody asks who it is."""

import asyncio

import pytest
import uvicorn
from uvicorn.server import ServerState

from service.http.listening import HEAD_BYTES_MAX, Connection

PART = b"a" * 4096


class Wire(asyncio.Transport):
    """Where the answers go."""

    def __init__(self) -> None:
        super().__init__()
        self.written, self.closed = b"", False

    def write(self, data: bytes) -> None:
        self.written += data

    def close(self) -> None:
        self.closed = True

    def is_closing(self) -> bool:
        return self.closed

    def pause_reading(self) -> None: ...

    def resume_reading(self) -> None: ...


async def send(*parts: bytes) -> tuple[bytes, int]:
    """Send parts as long as the connection is open; what was answered, and how many it took."""

    async def answer(_scope, receive, send) -> None:
        while (await receive()).get("more_body"):
            pass
        await send({"type": "http.response.start", "status": 204, "headers": []})
        await send({"type": "http.response.body"})

    wire = Wire()
    connection = Connection(uvicorn.Config(answer, log_config=None), ServerState(), {})
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
