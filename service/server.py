"""The life of the process: bind, answer, start, announce, serve until a signal, stop in seconds.

HTTP answers from the beginning, so that whoever watches a start sees how far it is; all but the
state of the service is 503 until it has started.
"""

import asyncio
import logging
import os
import signal
import socket
import sys
import threading
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from types import FrameType

import uvicorn

from service.access import check_exposure
from service.errors import SourceError
from service.http.app import create_app
from service.map_service import MapService
from service.priority import collect_what_is_new, share_interpreter
from service.settings import HttpSettings, Settings

logger = logging.getLogger(__name__)

_GRACE_S = 2  # for answers under way when the end comes
_SIGNALS = (signal.SIGINT, signal.SIGTERM)


def run(settings: Settings, announce: Callable[[str], None]) -> None:
    """Serve until SIGINT or SIGTERM.

    Args:
        settings: of everything.
        announce: told once, when the service can be reached, where that is.

    Raises:
        ConfigurationError: an address can be reached by strangers, and nothing keeps them out.
        SourceError: an address is taken or cannot be listened on; nothing is left running.
    """
    check_exposure(settings)
    share_interpreter()
    listener = _listen(settings.http)
    with listener:
        asyncio.run(_serve(settings, listener, announce))


def leave(code: int) -> None:
    """End the process here and now if a thread is still in compiled code, else do nothing.

    Such a thread cannot be interrupted, and an interpreter that is torn down under it crashes.
    """
    if any(thread.name.startswith("gpom-") for thread in threading.enumerate()):
        logging.shutdown()
        sys.stdout.flush()
        sys.stderr.flush()
        os._exit(code)


async def _serve(
    settings: Settings, listener: socket.socket, announce: Callable[[str], None]
) -> None:
    app = create_app(settings)
    service: MapService = app.state.service
    config = uvicorn.Config(
        app,
        lifespan="off",  # it would hold all answers back until the service has started
        log_config=None,
        access_log=False,
        timeout_graceful_shutdown=_GRACE_S,
        server_header=False,
        ssl_certfile=settings.http.tls_certificate,
        ssl_keyfile=settings.http.tls_key,
    )

    server = _Server(config, on_stopping=service.hang_up)
    serving = asyncio.create_task(server.serve(sockets=[listener]))
    starting = _in_thread(service.start)
    try:
        await asyncio.wait({serving, starting}, return_when=asyncio.FIRST_COMPLETED)
        if starting.done():
            starting.result()
            collect_what_is_new()
            zenoh = ",".join(service.endpoints) or "none"
            http = _url(listener, settings.http)
            announce(f"gpom: listening http={http} zenoh={zenoh} prefix={settings.zenoh.prefix}")
        await serving
    finally:
        server.should_exit = True
        await serving
        logger.info("stopping")
        if starting.done() and starting.exception() is None:
            await asyncio.to_thread(service.stop)


def _in_thread(call: Callable[[], None]) -> "asyncio.Future[None]":
    """Run something in a thread that `leave` does not wait for."""
    loop = asyncio.get_running_loop()
    done: asyncio.Future[None] = loop.create_future()

    def tell(error: BaseException | None) -> None:
        if done.cancelled():
            return
        if error is None:
            done.set_result(None)
        else:
            done.set_exception(error)

    def run() -> None:
        error = None
        try:
            call()
        except BaseException as caught:  # noqa: BLE001 - raised where the future is awaited
            error = caught
        with suppress(RuntimeError):  # the loop has ended: nobody wants to know
            loop.call_soon_threadsafe(tell, error)

    threading.Thread(target=run, name="gpom-start", daemon=True).start()
    return done


class _Server(uvicorn.Server):
    """uvicorn, ended by a signal with exit code 0 and without waiting for event streams."""

    def __init__(
        self,
        config: uvicorn.Config,
        *,
        on_stopping: Callable[[], None],
    ) -> None:
        super().__init__(config)
        self._on_stopping = on_stopping

    async def shutdown(self, sockets: Sequence[socket.socket] | None = None) -> None:
        self._on_stopping()
        await super().shutdown(None if sockets is None else list(sockets))

    @contextmanager
    def capture_signals(self) -> Iterator[None]:
        def stop(number: int, _: FrameType | None) -> None:
            logger.info("received %s", signal.Signals(number).name)
            self.should_exit = True

        # uvicorn's own raises the signal again at the end, which would spoil the exit code.
        before = {number: signal.signal(number, stop) for number in _SIGNALS}
        try:
            yield
        finally:
            for number, handler in before.items():
                signal.signal(number, handler)


def _listen(http: HttpSettings) -> socket.socket:
    family = socket.AF_INET6 if ":" in http.host else socket.AF_INET
    # asyncio switches Nagle's algorithm off only where the protocol is named, and with it every
    # answer waits 40 ms for the client's delayed acknowledgement.
    listener = socket.socket(family, socket.SOCK_STREAM, socket.IPPROTO_TCP)
    try:
        listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        listener.bind((http.host, http.port))
        listener.listen(2048)
    except OSError as error:
        listener.close()
        message = f"cannot listen on http://{http.host}:{http.port}: {error.strerror or error}"
        raise SourceError(message) from error
    return listener


def _url(listener: socket.socket, http: HttpSettings) -> str:
    host, port = listener.getsockname()[:2]
    scheme = "http" if http.tls_certificate is None else "https"
    return f"{scheme}://[{host}]:{port}" if ":" in host else f"{scheme}://{host}:{port}"
