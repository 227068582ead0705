"""The life of the process: bind, answer, start, announce, serve until a signal, stop in seconds.

HTTP answers from the beginning, so that whoever watches a start sees how far it is; all but the
state of the service is 503 until it has started. What HTTP needs is loaded beside the map: modules
keep the interpreter busy, compiled code and experts do not.
"""

import asyncio
import logging
import os
import socket
import sys
import threading
from collections.abc import Callable
from contextlib import suppress

from service.access import check_certificate, check_exposure
from service.assembly import assemble
from service.ending import Ending
from service.errors import SourceError
from service.map_service import MapService
from service.priority import collect_what_is_new, share_interpreter
from service.settings import HttpSettings, Settings

logger = logging.getLogger(__name__)


def run(settings: Settings, announce: Callable[[str], None], ending: Ending) -> None:
    """Serve until SIGINT or SIGTERM.

    Args:
        settings: of everything.
        announce: told once, when the service can be reached, where that is.
        ending: knows when it is time.

    Raises:
        ConfigurationError: an address can be reached by strangers, and nothing keeps them out.
        SourceError: an address is taken or cannot be listened on; nothing is left running.
    """
    check_exposure(settings)
    check_certificate(settings.http)
    share_interpreter()
    listener = _listen(settings.http)
    with listener:
        service = assemble(settings)
        if not ending.wanted:
            asyncio.run(_serve(service, listener, announce, ending))


def leave(code: int) -> None:
    """End the process here and now, unless nothing was begun that may still run.

    A thread in compiled code cannot be interrupted, one of zenoh's may yet call a function of
    ours: an interpreter that is torn down under them crashes.
    """
    if code == 0 or any(thread.name.startswith("gpom-") for thread in threading.enumerate()):
        logging.shutdown()
        sys.stdout.flush()
        sys.stderr.flush()
        os._exit(code)


async def _serve(
    service: MapService,
    listener: socket.socket,
    announce: Callable[[str], None],
    ending: Ending,
) -> None:
    starting = _in_thread(service.start)
    try:
        from service.http.listening import Server  # noqa: PLC0415 - beside the start, see above

        server = Server(service)
        ending.tell(server.exit_soon)
        serving = asyncio.create_task(server.serve(sockets=[listener]))
        try:
            await asyncio.wait({serving, starting}, return_when=asyncio.FIRST_COMPLETED)
            if starting.done():
                starting.result()
                collect_what_is_new()
                announce(_where(service, listener))
            await serving
        finally:
            server.exit_soon()
            await serving
    finally:
        logger.info("stopping")
        if starting.done() and starting.exception() is None:
            await asyncio.to_thread(service.stop)


def _where(service: MapService, listener: socket.socket) -> str:
    http, zenoh = service.settings.http, ",".join(service.endpoints) or "none"
    url, prefix = _url(listener, http), service.settings.zenoh.prefix
    return f"gpom: listening http={url} zenoh={zenoh} prefix={prefix}"


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
