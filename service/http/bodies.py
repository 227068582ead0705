"""Bodies within bounds, on every route: no more is taken into memory than one request may have.

And none is waited for without end: who never sent the rest would keep the places of a client for
ever. A slow link is no fault, so the time is one of pauses, and beyond it a rate.
"""

import asyncio
import logging
from collections.abc import Iterator
from contextlib import contextmanager, suppress

from starlette.datastructures import Headers
from starlette.requests import ClientDisconnect
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from gpom_core.errors import GpomError
from service.errors import BodyTimeoutError, PayloadTooLargeError, StoppingError
from service.http.errors import respond
from service.problems import problem_of

logger = logging.getLogger(__name__)

_RATE_MIN = 1000  # bytes/s; any link that is up carries more
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
    """ASGI middleware. A body that is too large is refused unread, or where it gets too large.

    One that does not come is refused when nothing of it came for `timeout_s`, or when more than
    that was waited beyond a second for each 1000 bytes.
    """

    def __init__(self, app: ASGIApp, bytes_max: int, timeout_s: float, uploads: Uploads) -> None:
        self._app = app
        self._bytes_max = bytes_max
        self._timeout_s = timeout_s
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
        exchange = _Exchange(self._bytes_max, self._timeout_s, self._uploads, receive, send)
        with suppress(ClientDisconnect):  # gone, or told so
            await self._app(scope, exchange.receive, exchange.send)
        await exchange.end(scope)


class _Exchange:
    """One request and its answer, on their way through."""

    def __init__(
        self, bytes_max: int, timeout_s: float, uploads: Uploads, receive: Receive, send: Send
    ) -> None:
        self._bytes_max = bytes_max
        self._timeout_s = timeout_s
        self._uploads = uploads
        self._receive = receive
        self._send = send
        self._size = 0
        self._waited_s = 0.0
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
            self._refusal = self._too_late()
            return _DISCONNECT
        if part["type"] == "http.disconnect":
            self._gone = self._is_missed()
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
        if not self._is_missed():
            return await self._receive()
        loop = asyncio.get_running_loop()
        start_s = loop.time()
        try:
            async with asyncio.timeout(self._patience_s()) as wait:
                with self._uploads.known(wait):
                    return await self._receive()
        except TimeoutError:
            if self._is_missed() or self._uploads.ended:
                raise
            return await self._receive()
        finally:
            self._waited_s += loop.time() - start_s

    def _is_missed(self) -> bool:
        """Whether an answer waits for more of the body; else who listens waits for the end."""
        return not (self._whole or self._answering)

    def _patience_s(self) -> float:
        """How long the next part may take; what has come is read in any case."""
        if self._uploads.ended:
            return 0.0
        return self._timeout_s + min(0.0, self._size / _RATE_MIN - self._waited_s)

    def _too_late(self) -> GpomError:
        if self._uploads.ended:
            return StoppingError("the service is shutting down")
        return BodyTimeoutError(
            f"{self._size} bytes of the body came in {self._waited_s:.1f} s, and not all: send "
            f"without a pause of {self._timeout_s:g} s (setting http.body_timeout_s), and after "
            f"so long at least {_RATE_MIN} bytes/s"
        )


def _too_large(bytes_max: int) -> PayloadTooLargeError:
    return PayloadTooLargeError(
        f"the body is larger than the {bytes_max} bytes that are allowed: split the query"
    )
