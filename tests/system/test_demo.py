"""``gpom demo`` as a newcomer meets it: real processes, a real map, the README's question."""

import re
import signal
import socket
import subprocess
import sys
import threading
from collections.abc import Iterator
from pathlib import Path

import pytest

from clients.map_client import MapClient

README = (Path(__file__).parents[2] / "README.md").read_text(encoding="utf-8")
START_TIMEOUT_S = 240.0  # compiles every loop when nothing is cached


def free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


def read_until(process: subprocess.Popen[str], pattern: str) -> re.Match[str]:
    """Read lines until one matches; the end of the output, or of patience, is a failure."""
    assert process.stdout is not None
    impatience = threading.Timer(START_TIMEOUT_S, process.terminate)
    impatience.start()
    try:
        seen = []
        for line in process.stdout:
            seen.append(line)
            if match := re.search(pattern, line):
                return match
    finally:
        impatience.cancel()
    pytest.fail(f"no line matches {pattern}:\n{''.join(seen)}")


@pytest.fixture
def demo() -> Iterator[subprocess.Popen[str]]:
    ports = ("--port", str(free_port()), "--zenoh-port", str(free_port()))
    command = (sys.executable, "-m", "clients.cli", "demo", "--no-browser", *ports)
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:
        try:
            yield process
        finally:
            process.terminate()


@pytest.mark.slow
@pytest.mark.timeout(400)
def test_robots_map_a_building_and_the_readme_asks_about_it(
    demo: subprocess.Popen[str], capsys: pytest.CaptureFixture[str]
) -> None:
    url = read_until(demo, r"http://127\.0\.0\.1:\d+").group()
    read_until(demo, r"robots 3 .*experts [1-9]\d* .*map version [1-9]")
    (example,) = (
        block
        for block in re.findall(r"```python\n(.*?)```", README, flags=re.DOTALL)
        if "MapClient" in block
    )
    exec(example.replace("http://127.0.0.1:8080", url), {})  # noqa: S102 - our own README
    assert "probability of being occupied: [" in capsys.readouterr().out
    with MapClient(url) as site:
        assert {robot.scans > 0 for robot in site.status().robots} == {True}

    demo.send_signal(signal.SIGTERM)
    assert demo.wait(60) == 0
    with pytest.raises(ConnectionRefusedError):
        socket.create_connection(("127.0.0.1", int(url.rpartition(":")[2])), timeout=5)
