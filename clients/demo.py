"""``gpom demo``: a service and simulated robots on this machine, with one command.

The two are processes of their own, as they would be on a site; only their addresses meet here.
"""

import os
import socket
import sys
import tempfile
import time
import webbrowser
from contextlib import ExitStack, suppress
from pathlib import Path
from threading import Event
from typing import Annotated

import typer
from rich.console import Console
from rich.live import Live

from clients.children import Child, ChildFailedError, stop_on_signal
from clients.errors import MapServiceError, MapUnreachableError
from clients.map_client import MapClient

HOST = "127.0.0.1"
HTTP_PORT = 8080
ZENOH_PORT = 7447
START_TIMEOUT_S = 900.0  # the first start compiles the loops: minutes on a busy machine
POLL_S = 0.25
REFRESH_S = 1.0
PLAIN_REFRESH_S = 5.0  # without a terminal, each refresh is a line of its own

HttpPort = Annotated[
    int | None, typer.Option(help=f"HTTP port; default {HTTP_PORT}, or a free one.", min=1)
]
ZenohPort = Annotated[
    int | None, typer.Option(help=f"zenoh port; default {ZENOH_PORT}, or a free one.", min=1)
]
Robots = Annotated[int, typer.Option(help="Simulated robots.", min=1)]
Duration = Annotated[float | None, typer.Option(help="End after so long; default: never.", min=0)]
Browser = Annotated[bool, typer.Option(help="Open the map in a browser, if there is one.")]


def demo(
    port: HttpPort = None,
    zenoh_port: ZenohPort = None,
    robots: Robots = 3,
    duration_s: Duration = None,
    browser: Browser = True,
) -> None:
    """Run a service and simulated robots that map a building, until Ctrl-C."""
    console = Console()
    url = f"http://{HOST}:{port or _free_port(HTTP_PORT)}"
    endpoint = f"tcp/{HOST}:{zenoh_port or _free_port(ZENOH_PORT)}"
    with ExitStack() as stack:
        stop = stack.enter_context(stop_on_signal())
        logs = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="gpom-demo-")))
        console.print(
            "starting the map service; its first start ever compiles for a minute or two …"
        )
        service = stack.enter_context(_gpom("serve", logs, *_serve_flags(url, endpoint)))
        site = stack.enter_context(MapClient(url))
        if not _wait_until_ready(site, service, stop):
            return
        console.print(f"the live map: [bold]{url}[/bold]   (Ctrl-C ends it)", highlight=False)
        if browser:
            _open_in_browser(url)
        flags = ("--robots", str(robots), "--connect", endpoint)
        fleet = stack.enter_context(_gpom("simulate", logs, *flags))
        _show_progress(console, site, service, fleet, stop, duration_s)
        console.print("ending the robots and the service …")


def _gpom(command: str, logs: Path, *flags: str) -> Child:
    program = (sys.executable, "-m", "clients.cli", command)
    return Child(f"gpom {command}", (*program, *flags), logs / f"{command}.log")


def _serve_flags(url: str, endpoint: str) -> tuple[str, ...]:
    return ("--host", HOST, "--port", url.rpartition(":")[2], "--zenoh-listen", endpoint)


def _free_port(preferred: int) -> int:
    for port in (preferred, 0):
        with socket.socket() as probe:
            probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            try:
                probe.bind((HOST, port))
            except OSError:
                continue
            number: int = probe.getsockname()[1]
            return number
    raise OSError(f"no free port on {HOST}")


def _wait_until_ready(site: MapClient, service: Child, stop: Event) -> bool:
    """Wait for the service; give False when told to stop before it is there."""
    end = time.monotonic() + START_TIMEOUT_S
    while not stop.wait(POLL_S):
        service.must_run()
        with suppress(MapUnreachableError):  # not listening yet
            if site.ready():
                return True
        if time.monotonic() > end:
            raise ChildFailedError(f"`{service.name}` is not ready after {START_TIMEOUT_S:g} s")
    return False


def _open_in_browser(url: str) -> None:
    # Without a screen, webbrowser may start a text browser in this very terminal.
    screen = sys.platform != "linux" or "DISPLAY" in os.environ or "WAYLAND_DISPLAY" in os.environ
    if screen and sys.stdout.isatty():
        webbrowser.open(url)


def _show_progress(
    console: Console,
    site: MapClient,
    service: Child,
    fleet: Child,
    stop: Event,
    duration_s: float | None,
) -> None:
    end = float("inf") if duration_s is None else time.monotonic() + duration_s
    refresh_s = REFRESH_S if console.is_terminal else PLAIN_REFRESH_S
    with Live(console=console, auto_refresh=False) as live:
        while not stop.is_set():
            service.must_run()
            fleet.is_running()  # raises when it failed; robots may come to their end
            line = _progress_line(site)
            if console.is_terminal:
                live.update(line, refresh=True)
            else:
                console.print(line)
            left_s = end - time.monotonic()
            if left_s <= 0 or stop.wait(min(refresh_s, left_s)):
                return


def _progress_line(site: MapClient) -> str:
    try:
        status = site.status()
    except MapServiceError as error:
        return f"no status: {error}"
    return (
        f"robots {len(status.robots)}   scans {status.scans_integrated}   "
        f"experts {status.experts}   map version {status.map_version}"
    )
