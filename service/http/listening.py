"""uvicorn, with the app of a service that may still be starting."""

import asyncio
import socket
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from functools import partial
from typing import Any, cast

import uvicorn
from uvicorn.protocols.http.httptools_impl import HttpToolsProtocol

from service.http.app import create_app
from service.http.bodies import Uploads
from service.map_service import MapService

_GRACE_S = 2  # for answers under way when the end comes
HEAD_BYTES_MAX = 64 * 1024
_TOO_SLOW = b"HTTP/1.1 408 Request Timeout\r\ncontent-length: 0\r\nconnection: close\r\n\r\n"


class Connection(HttpToolsProtocol):
    """uvicorn's, with an end to heads: it would remember a header of any size, from anybody.

    The same holds for trailers and for what may stand beside the sizes of chunks. It would also
    wait for ever for a head, or for the rest of a body whose answer was given; one timer for each
    connection, not for each request, ends that.

    Args:
        head_timeout_s: a head has so long from when the connection was made, or from its first
            byte behind an answer. uvicorn ends what is idle behind an answer, sooner.
    """

    def __init__(self, *args: Any, head_timeout_s: float, **kwargs: Any) -> None:
        super().__init__(*args, **kwargs)
        self._head_timeout_s = head_timeout_s
        self._waiting_since_s: float | None = None  # None: a request is being answered, or was
        self._timer: asyncio.TimerHandle | None = None
        self._pending_bytes = 0

    def connection_made(self, transport: asyncio.Transport) -> None:  # type: ignore[override] # as uvicorn has it
        """Begin to wait for a request."""
        super().connection_made(transport)
        self._waiting_since_s = self.loop.time()
        self._look_again(self._waiting_since_s + self._head_timeout_s)

    def connection_lost(self, exc: Exception | None) -> None:
        """Wait no more."""
        if self._timer is not None:
            self._timer.cancel()
        super().connection_lost(exc)

    def data_received(self, data: bytes) -> None:
        """Parse what came; hang up when nothing was made of too much."""
        if self._waiting_since_s is None and getattr(self.cycle, "response_complete", False):
            self._waiting_since_s = self.loop.time()
        self._pending_bytes += len(data)
        super().data_received(data)
        if self._pending_bytes <= HEAD_BYTES_MAX or self.transport.is_closing():
            return
        if getattr(self.cycle, "response_complete", True):  # None before the first request
            self.send_400_response(f"The head of the request has over {HEAD_BYTES_MAX} bytes.")
        else:
            self.transport.close()

    def on_headers_complete(self) -> None:
        """Go on to the body."""
        self._pending_bytes = 0
        self._waiting_since_s = None
        super().on_headers_complete()

    def on_body(self, body: bytes) -> None:
        """Take a part of the body."""
        self._pending_bytes = 0
        super().on_body(body)

    def on_message_complete(self) -> None:
        """Go on to the next request."""
        self._pending_bytes = 0
        super().on_message_complete()
        if getattr(self.cycle, "response_complete", False):  # of a body that nobody read
            self._waiting_since_s = self.loop.time()

    def _look_again(self, at_s: float) -> None:
        self._timer = self.loop.call_at(at_s, self._end_wait)

    def _end_wait(self) -> None:
        """Hang up if it is time, or look again when it may be."""
        if self.transport.is_closing():
            return
        now_s, since_s = self.loop.time(), self._waiting_since_s
        due_s = (now_s if since_s is None else since_s) + self._head_timeout_s
        if due_s > now_s:
            self._look_again(due_s)
            return
        if self._pending_bytes:
            self.transport.write(_TOO_SLOW)
        self.transport.close()


class Server(uvicorn.Server):
    """Leaves signals alone, and does not wait for event streams when it is told to exit."""

    def __init__(self, service: MapService) -> None:
        http = service.settings.http
        app = create_app(service)
        config = uvicorn.Config(
            app,
            http=cast(
                "type[asyncio.Protocol]", partial(Connection, head_timeout_s=http.head_timeout_s)
            ),
            lifespan="off",  # it would hold all answers back until the service has started
            log_config=None,
            access_log=False,
            timeout_graceful_shutdown=_GRACE_S,
            server_header=False,
            ssl_certfile=http.tls_certificate,
            ssl_keyfile=http.tls_key,
        )
        super().__init__(config)
        self._service = service
        self._uploads: Uploads = app.state.uploads

    async def shutdown(self, sockets: Sequence[socket.socket] | None = None) -> None:
        """End what keeps connections open, then the connections."""
        self._service.hang_up()
        self._uploads.end()
        await super().shutdown(None if sockets is None else list(sockets))

    def exit_soon(self) -> None:
        """Let `serve` end, within seconds."""
        self.should_exit = True

    @contextmanager
    def capture_signals(self) -> Iterator[None]:
        """Do nothing: `service.ending` hears them, from long before this one exists."""
        yield
