"""No route takes more into memory, or waits longer, than one request may have, whoever reads."""

import asyncio
import json
import logging
import selectors
from collections.abc import AsyncIterator

import pytest
from fastapi import Body, FastAPI, Request
from fastapi.responses import StreamingResponse

from service.http import errors
from service.http.bodies import Bodies, Uploads

TIMEOUT_S = 30.0
GONE = {"type": "http.disconnect"}
WHEN_BEGUN = {"then": "the next part, once an answer has begun"}
Part = bytes | dict | float
"""Of a body, a message, or seconds of waiting; nothing more ever comes after the last one."""


class Clock(selectors.DefaultSelector):
    """Waits for nothing: time goes on at once to when something is due."""

    now_s = 0.0

    def select(self, timeout: float | None = None) -> list:
        self.now_s += timeout or 0.0
        return super().select(None if timeout is None else 0.0)


def run(scene):
    """Run a coroutine in a loop with a clock of its own; its result."""
    clock = Clock()
    loop = asyncio.SelectorEventLoop(clock)
    loop.time = lambda: clock.now_s
    with asyncio.Runner(loop_factory=lambda: loop) as runner:
        return runner.run(scene)


class Exchange:
    """A request whose body comes in parts, and what was answered."""

    def __init__(
        self, path: str, parts: list[Part], stated: int | None = None, bytes_max: int = 100
    ) -> None:
        self.bytes_max = bytes_max
        self.uploads = Uploads()
        self.sent: list[dict] = []
        self.waiting = list(parts)
        self.idle, self.begun = asyncio.Event(), asyncio.Event()
        headers = [(b"content-type", b"application/json")]
        if stated is not None:
            headers.append((b"content-length", b"%d" % stated))
        self._scope = {
            "type": "http",
            "method": "POST",
            "path": path,
            "query_string": b"",
            "headers": headers,
        }

    async def run(self) -> None:
        app = Bodies(_application(), self.bytes_max, TIMEOUT_S, self.uploads)
        await app(self._scope, self._receive, self._send)

    @property
    def status(self) -> int:
        return self.sent[0]["status"]

    @property
    def headers(self) -> dict[bytes, bytes]:
        return dict(self.sent[0]["headers"])

    @property
    def content(self) -> bytes:
        return b"".join(message.get("body", b"") for message in self.sent)

    async def _receive(self) -> dict:
        if not self.waiting:
            self.idle.set()
            await asyncio.Event().wait()
        if self.waiting[0] is WHEN_BEGUN:
            await self.begun.wait()
            del self.waiting[0]
        if isinstance(self.waiting[0], float):
            await asyncio.sleep(self.waiting[0])
            del self.waiting[0]
        part = self.waiting.pop(0)
        if isinstance(part, dict):
            return part
        return {"type": "http.request", "body": part, "more_body": part != b""}

    async def _send(self, message: dict) -> None:
        self.sent.append(message)
        if "body" in message:
            self.begun.set()


def _application() -> FastAPI:
    app = FastAPI()
    errors.install(app)

    @app.post("/whole")
    async def whole(request: Request) -> dict[str, int]:
        return {"read": len(await request.body())}

    @app.post("/parsed")
    async def parsed(value: str = Body()) -> dict[str, int]:
        return {"read": len(value) + 2}

    @app.post("/stream")
    async def stream() -> StreamingResponse:
        async def news() -> AsyncIterator[str]:
            for _ in range(100):
                yield "news"
                await asyncio.sleep(1.0)

        return StreamingResponse(news())

    return app


def ask(path: str, parts: list[Part], stated: int | None = None) -> Exchange:
    exchange = Exchange(path, parts, stated)
    run(exchange.run())
    return exchange


@pytest.mark.parametrize("path", ["/whole", "/parsed"])
def test_a_body_is_refused_where_it_gets_too_large(path: str) -> None:
    exchange = ask(path, [b'"' * 60] * 9)
    problem = json.loads(exchange.content)
    assert exchange.status == problem["status"] == 413
    assert "100 bytes" in problem["detail"]
    assert len(exchange.waiting) == 7


@pytest.mark.parametrize("path", ["/whole", "/parsed"])
def test_a_body_that_says_so_is_refused_unread(path: str) -> None:
    exchange = ask(path, [b"x" * 60] * 2, 120)
    assert (exchange.status, len(exchange.waiting)) == (413, 2)


def test_what_is_allowed_passes() -> None:
    exchange = ask("/whole", [b"x" * 60, b"x" * 40, b""], 100)
    assert (exchange.status, json.loads(exchange.content)) == (200, {"read": 100})
    exchange = ask("/parsed", [b'""', b""], 2)
    assert (exchange.status, json.loads(exchange.content)) == (200, {"read": 2})


def test_a_stream_ends_where_a_body_that_nobody_reads_gets_too_large() -> None:
    exchange = ask("/stream", [b"x" * 60, WHEN_BEGUN, b"x" * 60, b"x" * 60])
    assert exchange.status == 200
    assert exchange.content.startswith(b"news")
    assert not exchange.sent[-1].get("more_body", False)
    assert len(exchange.waiting) == 1
    assert ask("/stream", [b"x" * 60, b"x" * 60]).status == 413, "nothing was said yet"


@pytest.mark.parametrize("path", ["/whole", "/parsed"])
def test_a_client_that_goes_away_is_no_error(path: str, caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level(logging.DEBUG, "service")
    exchange = ask(path, [b"x", GONE])
    assert exchange.sent == []
    (record,) = caplog.records
    assert (record.levelname, record.exc_info) == ("DEBUG", None)
    assert path in record.getMessage()


@pytest.mark.parametrize("path", ["/whole", "/parsed"])
def test_the_end_of_the_service_does_not_wait_for_bodies(path: str) -> None:
    async def scene() -> Exchange:
        exchange = Exchange(path, [b"x"])
        running = asyncio.create_task(exchange.run())
        await exchange.idle.wait()
        exchange.uploads.end()
        await running
        return exchange

    exchange = run(scene())
    problem = json.loads(exchange.content)
    assert exchange.status == problem["status"] == 503
    assert problem["type"] == "urn:gpom:problem:stopping"
    assert exchange.headers[b"connection"] == b"close"


def test_a_body_that_has_come_is_read_at_the_end_too() -> None:
    async def scene(*parts: bytes) -> Exchange:
        exchange = Exchange("/whole", [*parts])
        exchange.uploads.end()
        await exchange.run()
        return exchange

    assert run(scene(b"x", b"")).status == 200
    assert run(scene(b"x")).status == 503


@pytest.mark.parametrize("path", ["/whole", "/parsed"])
@pytest.mark.parametrize(
    "parts",
    [
        pytest.param([], id="nothing"),
        pytest.param([b"x", TIMEOUT_S + 0.1, b"x", b""], id="a pause"),
        pytest.param([b"x", 20.0, b"x", 20.0, b"x", b""], id="a drip"),
    ],
)
def test_a_body_that_does_not_come_in_time_is_refused(path: str, parts: list[Part]) -> None:
    exchange = ask(path, parts)
    problem = json.loads(exchange.content)
    assert exchange.status == problem["status"] == 408
    assert "http.body_timeout_s" in problem["detail"]
    assert exchange.headers[b"connection"] == b"close"


def test_a_slow_body_is_not_refused_while_it_comes() -> None:
    steady = [part for _ in range(500) for part in (b"x" * 1100, 1.0)]
    exchange = Exchange("/whole", [*steady, b""], bytes_max=10**6)
    run(exchange.run())
    assert (exchange.status, json.loads(exchange.content)) == (200, {"read": 550_000})
    assert ask("/whole", [b"x", TIMEOUT_S - 0.1, b"x", b""]).status == 200


@pytest.mark.parametrize("parts", [[b"x"], [b"x", b""]])
def test_a_stream_outlasts_the_time_that_bodies_have(parts: list[Part]) -> None:
    exchange = ask("/stream", parts)
    assert (exchange.status, exchange.content) == (200, b"news" * 100)
