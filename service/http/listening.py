"""uvicorn, with the app of a service that may still be starting."""

import socket
from collections.abc import Iterator, Sequence
from contextlib import contextmanager

import uvicorn
from uvicorn.protocols.http.httptools_impl import HttpToolsProtocol

from service.http.app import create_app
from service.http.bodies import Uploads
from service.map_service import MapService

_GRACE_S = 2  # for answers under way when the end comes
HEAD_BYTES_MAX = 64 * 1024


class Connection(HttpToolsProtocol):
    """uvicorn's, with an end to heads: it would remember a header of any size, from anybody.

    The same holds for trailers and for what may stand beside the sizes of chunks.
    """

    _pending_bytes = 0

    def data_received(self, data: bytes) -> None:
        """Parse what came; hang up when nothing was made of too much."""
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
        super().on_headers_complete()

    def on_body(self, body: bytes) -> None:
        """Take a part of the body."""
        self._pending_bytes = 0
        super().on_body(body)

    def on_message_complete(self) -> None:
        """Go on to the next request."""
        self._pending_bytes = 0
        super().on_message_complete()


class Server(uvicorn.Server):
    """Leaves signals alone, and does not wait for event streams when it is told to exit."""

    def __init__(self, service: MapService) -> None:
        http = service.settings.http
        app = create_app(service)
        config = uvicorn.Config(
            app,
            http=Connection,
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
