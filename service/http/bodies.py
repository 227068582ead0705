"""Bodies within bounds, on every route: no more is taken into memory than one request may have."""

import asyncio
import logging
from collections.abc import Iterator
from contextlib import contextmanager, suppress

from starlette.datastructures import Headers
from starlette.requests import ClientDisconnect
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from gpom_core.errors import GpomError
from service.errors import PayloadTooLargeError, StoppingError
from service.http.errors import respond
from service.problems import problem_of

logger = logging.getLogger(__name__)

_DISCONNECT: Message = {"type": "http.disconnect"}


class Uploads:
    """Bodies that are waited for, so that the end of the service need not wait for them."""

    def __init__(self) -> None:
        self.ended = False
        self._waits: set[asyncio.Timeout] = set()

    def end(self) -> None:
        """Let no wait go on, and what has not come then be missing."""
        self.ended = True
        for wait in self._waits:
            if not wait.expired():
                wait.reschedule(0.0)

    @contextmanager
    def known(self, wait: asyncio.Timeout) -> Iterator[None]:
        """Have a wait, which was entered, ended with all others."""
        self._waits.add(wait)
        try:
            yield
        finally:
            self._waits.discard(wait)


class Bodies:
    """ASGI middleware. A body that is too large is refused unread, or where it gets too large."""

    def __init__(self, app: ASGIApp, bytes_max: int, uploads: Uploads) -> None:
        self._app = app
        self._bytes_max = bytes_max
        self._uploads = uploads

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Handle one connection."""
        if scope["type"] != "http":
            await self._app(scope, receive, send)
            return
        stated = Headers(scope=scope).get("content-length", "")
        if stated.isdecimal() and int(stated) > self._bytes_max:
            await respond(problem_of(_too_large(self._bytes_max)))(scope, receive, send)
            return
        exchange = _Exchange(self._bytes_max, self._uploads, receive, send)
        with suppress(ClientDisconnect):  # gone, or told so
            await self._app(scope, exchange.receive, exchange.send)
        await exchange.end(scope)


class _Exchange:
    """One request and its answer, on their way through."""

    def __init__(self, bytes_max: int, uploads: Uploads, receive: Receive, send: Send) -> None:
        self._bytes_max = bytes_max
        self._uploads = uploads
        self._receive = receive
        self._send = send
        self._size = 0
        self._whole = False
        self._answering = self._answered = False
        self._gone = False
        self._refusal: GpomError | None = None

    async def receive(self) -> Message:
        """Pass on a part of the body. Of one that is refused there is no more: the client is gone.

        An error would not do: whoever reads the body may make another one of it.
        """
        if self._refusal is not None:
            return _DISCONNECT
        try:
            part = await self._part()
        except TimeoutError:
            self._refusal = StoppingError("the service is shutting down")
            return _DISCONNECT
        if part["type"] == "http.disconnect":
            self._gone = not (self._whole or self._answering)
            return part
        self._size += len(part.get("body", b""))
        self._whole = not part.get("more_body", False)
        if self._size > self._bytes_max:
            self._refusal = _too_large(self._bytes_max)
            return _DISCONNECT
        return part

    async def send(self, part: Message) -> None:
        """Pass on a part of the answer, unless it is what was made of a body that did not come."""
        if self._gone or (self._refusal is not None and not self._answering):
            return
        self._answering = True
        self._answered = part["type"] == "http.response.body" and not part.get("more_body", False)
        await self._send(part)

    async def end(self, scope: Scope) -> None:
        """Say why the body is refused, or, where an answer has begun, end it."""
        if self._gone:
            logger.debug("the client went away while it sent its body: path=%r", scope["path"])
        if self._refusal is None or self._answered:
            return
        if self._answering:
            await self._send({"type": "http.response.body", "body": b"", "more_body": False})
            return
        answer = respond(problem_of(self._refusal))
        if not isinstance(self._refusal, PayloadTooLargeError):
            answer.headers["Connection"] = "close"
        await answer(scope, self._receive, self._send)

    async def _part(self) -> Message:
        if self._whole or self._answering:  # who listens now waits for the client to go
            return await self._receive()
        async with asyncio.timeout(0.0 if self._uploads.ended else None) as wait:
            with self._uploads.known(wait):
                return await self._receive()


def _too_large(bytes_max: int) -> PayloadTooLargeError:
    return PayloadTooLargeError(
        f"the body is larger than the {bytes_max} bytes that are allowed: split the query"
    )
