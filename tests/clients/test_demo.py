"""How the demo holds its processes together, with stand-ins for the service and the robots."""

import os
import signal
import socket
import sys
from pathlib import Path

import pytest
import typer
from typer.testing import CliRunner

from clients import demo
from clients.children import Child, ChildFailedError

SERVICE = """
import json, sys
from http.server import BaseHTTPRequestHandler, HTTPServer

STATUS = {
    "map_version": 7, "scans_received": 42, "scans_integrated": 41, "experts": 5,
    "dirty_experts": 0, "observations": 99, "robots": [], "bounds": None,
}

class Handler(BaseHTTPRequestHandler):
    def do_GET(self):
        self.send_response(200)
        self.send_header("Content-Type", "application/json")
        self.end_headers()
        self.wfile.write(json.dumps(STATUS).encode())

port = int(sys.argv[sys.argv.index("--port") + 1])
HTTPServer(("127.0.0.1", port), Handler).serve_forever()
"""
DRIVE = "import time; time.sleep(60)"
CRASH = "raise SystemExit('no router answers')"

app = typer.Typer()
app.command()(demo.demo)


@pytest.fixture
def children(monkeypatch: pytest.MonkeyPatch) -> dict[str, str]:
    """Let tests choose the code that each command runs; robots drive unless told otherwise."""
    code = {"serve": SERVICE, "simulate": DRIVE}

    def start(command: str, logs: Path, *flags: str) -> Child:
        program = (sys.executable, "-c", code[command], *flags)
        started.append(Child(f"gpom {command}", program, logs / command))
        return started[-1]

    started: list[Child] = []
    monkeypatch.setattr(demo, "_gpom", start)
    monkeypatch.setattr(demo, "PLAIN_REFRESH_S", 0.1)
    yield code
    for child in started:
        with pytest.raises(ProcessLookupError):
            os.kill(child.pid, 0)


def test_it_shows_the_address_and_the_progress(children: dict[str, str]) -> None:
    result = CliRunner().invoke(app, ["--duration-s", "0.5"])

    assert result.exit_code == 0, result.output
    assert "http://127.0.0.1:" in result.output
    assert "scans 41   experts 5   map version 7" in result.output


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_ends_it_cleanly(
    children: dict[str, str], number: signal.Signals, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(demo, "_open_in_browser", lambda _: os.kill(os.getpid(), number))

    assert CliRunner().invoke(app, []).exit_code == 0


@pytest.mark.parametrize("command", ["serve", "simulate"])
def test_a_process_that_fails_ends_it(children: dict[str, str], command: str) -> None:
    children[command] = CRASH

    result = CliRunner().invoke(app, [])

    assert isinstance(result.exception, ChildFailedError)
    assert f"gpom {command}" in str(result.exception)
    assert "no router answers" in str(result.exception)


def test_robots_that_arrive_leave_the_map_to_be_looked_at(children: dict[str, str]) -> None:
    children["simulate"] = "pass"

    assert CliRunner().invoke(app, ["--duration-s", "1"]).exit_code == 0


def test_a_service_that_never_gets_ready_is_given_up(
    children: dict[str, str], monkeypatch: pytest.MonkeyPatch
) -> None:
    children["serve"] = DRIVE
    monkeypatch.setattr(demo, "START_TIMEOUT_S", 0.5)

    result = CliRunner().invoke(app, [])

    assert isinstance(result.exception, ChildFailedError)
    assert "not ready after 0.5 s" in str(result.exception)


def test_a_taken_port_is_left_alone() -> None:
    with socket.create_server(("127.0.0.1", 0)) as taken:
        number = taken.getsockname()[1]

        assert demo._free_port(number) != number

    assert demo._free_port(number) == number
