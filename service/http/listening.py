"""uvicorn, with the app of a service that may still be starting."""

import socket
from collections.abc import Iterator, Sequence
from contextlib import contextmanager

import uvicorn

from service.http.app import create_app
from service.http.bodies import Uploads
from service.map_service import MapService

_GRACE_S = 2  # for answers under way when the end comes


class Server(uvicorn.Server):
    """Leaves signals alone, and does not wait for event streams when it is told to exit."""

    def __init__(self, service: MapService) -> None:
        http = service.settings.http
        app = create_app(service)
        config = uvicorn.Config(
            app,
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
