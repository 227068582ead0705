"""The real process: signals, ports, event streams."""

import json
import re
import signal
import socket
import subprocess
import sys
import threading
import time
from contextlib import contextmanager, suppress
from pathlib import Path
from urllib.parse import urlsplit

import httpx

from service.points import JSON
from tests.faults.parts import free_port
from tests.service.fleet_link import open_session
from tests.service.rooms import payload_at

COMMAND = [sys.executable, "-c", "import typer; from service.cli import serve; typer.run(serve)"]
PREFIX = "gpom/v1/site"


class Process:
    """A service in a process of its own, on ports that the machine picked."""

    def __init__(self, *flags: str) -> None:
        ports = ("--port", "0", "--zenoh-listen", "tcp/127.0.0.1:0")
        self.child = subprocess.Popen(
            [*COMMAND, *ports, *flags], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
        )
        line = self.child.stdout.readline()
        found = re.fullmatch(r"gpom: listening http=(\S+) zenoh=(\S+) prefix=(\S+)\n", line)
        assert found, line + self.child.stderr.read()
        self.url, self.zenoh, self.prefix = found.groups()

    def wait_until_ready(self) -> None:
        end_s = time.monotonic() + 300.0
        while not httpx.get(f"{self.url}/readyz").is_success:
            assert time.monotonic() < end_s
            time.sleep(0.05)

    def end(self, number: signal.Signals) -> tuple[int, float, str]:
        start_s = time.monotonic()
        self.child.send_signal(number)
        _, errors = self.child.communicate(timeout=30.0)
        return self.child.returncode, time.monotonic() - start_s, errors


@contextmanager
def _running(*flags: str):
    process = Process(*flags)
    try:
        yield process
    finally:
        if process.child.poll() is None:
            process.child.kill()
            process.child.communicate()


def _events(response: httpx.Response):
    """The named events of a stream, with their data."""
    name = None
    for line in response.iter_lines():
        if line.startswith("event: "):
            name = line.removeprefix("event: ")
        elif line.startswith("data: "):
            yield name, json.loads(line.removeprefix("data: "))


def _begun(url: str, head: bytes) -> socket.socket:
    """Connect, and send a part of a head."""
    address = urlsplit(url)
    client = socket.create_connection((address.hostname, address.port), timeout=30.0)
    client.sendall(head)
    return client


def _half_sent(url: str, path: str) -> socket.socket:
    """Post a body of which only the first byte comes, once the service waits for it."""
    client = _begun(
        url,
        f"POST {path} HTTP/1.1\r\nHost: test\r\nContent-Type: {JSON}\r\nContent-Length: 100\r\n"
        "Expect: 100-continue\r\n\r\n".encode(),
    )
    assert _read_until(client, b"100 Continue\r\n\r\n")
    client.sendall(b"{")
    return client


def _send_too_much(url: str) -> None:
    """Follow events, and send what nobody reads, until the stream ends."""
    address = urlsplit(url)
    with socket.create_connection((address.hostname, address.port), timeout=30.0) as client:
        client.sendall(
            b"GET /v1/events HTTP/1.1\r\nHost: test\r\nTransfer-Encoding: chunked\r\n\r\n"
        )
        assert b"event: map" in _read_until(client, b"event: map")
        client.sendall(b"%x\r\n%s\r\n" % (200_000, b"x" * 200_000))
        assert _read_until(client, b"0\r\n\r\n").endswith(b"0\r\n\r\n")


def _read_until(client: socket.socket, end: bytes) -> bytes:
    """Receive until something came, or all if it never does."""
    received = b""
    while end not in received and (part := client.recv(65_536)):
        received += part
    return received


def test_an_interrupt_ends_it_cleanly_with_streams_and_uploads_open(monkeypatch) -> None:
    monkeypatch.setenv("GPOM_HTTP__BODY_BYTES_MAX", "100000")
    monkeypatch.setenv("GPOM_HTTP__HEAD_TIMEOUT_S", "3")
    with _running() as process:
        silent = [_begun(process.url, head) for head in (b"", b"GET / HTTP/1.1\r\nHost: te")]
        ended = threading.Event()

        def listen() -> None:
            with httpx.stream("GET", f"{process.url}/v1/events", timeout=30.0) as response:
                for _ in response.iter_raw():
                    streaming.set()
            ended.set()

        streaming = threading.Event()
        listener = threading.Thread(target=listen)
        listener.start()
        assert streaming.wait(10.0)
        _send_too_much(process.url)
        for path in ("/v1/query", "/v1/flush"):
            _half_sent(process.url, path).close()
        uploads = [_half_sent(process.url, path) for path in ("/v1/query", "/v1/flush") * 2]
        said = [_read_until(client, b"all of it") for client in silent]
        assert [answer.partition(b"\r\n")[0] for answer in said] == [
            b"",
            b"HTTP/1.1 408 Request Timeout",
        ]
        code, took_s, errors = process.end(signal.SIGINT)
        assert code == 0, errors
        assert took_s < 5.0
        assert "Traceback" not in errors
        assert "level=ERROR" not in errors
        assert ended.wait(5.0), "the stream ended in an orderly way"
        listener.join()
        for client in silent:
            client.close()
        for upload in uploads:
            with upload:
                answer = _read_until(upload, b"all of it")
            assert answer.startswith(b"HTTP/1.1 503")
            assert b"urn:gpom:problem:stopping" in answer


def test_a_long_answer_does_not_hold_the_end() -> None:
    with _running() as process, open_session(connect=process.zenoh) as robot:
        process.wait_until_ready()
        robot.put(f"{PREFIX}/r1/scan/front", payload_at(seq=1))
        while not httpx.get(f"{process.url}/v1/status").json()["scans_received"]:
            time.sleep(0.01)
        httpx.post(f"{process.url}/v1/flush", timeout=60.0).raise_for_status()

        def draw() -> None:
            with suppress(httpx.HTTPError):
                url = f"{process.url}/v1/grid?bbox=-3,-3,3,3&resolution=0.0031"
                httpx.get(url, timeout=60.0)

        client = threading.Thread(target=draw)
        client.start()
        time.sleep(0.3)
        code, took_s, errors = process.end(signal.SIGTERM)
        client.join()
        assert code == 0, errors
        assert took_s < 5.0
        assert "Traceback" not in errors


def test_from_robot_to_events_and_answers() -> None:
    with _running() as process, open_session(connect=process.zenoh) as robot:
        process.wait_until_ready()
        with httpx.stream("GET", f"{process.url}/v1/events", timeout=60.0) as response:
            events = (event for event in _events(response) if event[0] in {"map", "robot"})
            _, first = next(events)
            assert (first["map_version"], first["changed"]) == (0, None)
            token = robot.liveliness().declare_token(f"{PREFIX}/r1/alive")
            assert next(events) == ("robot", {"robot": "r1", "alive": True})
            robot.put(f"{PREFIX}/r1/scan/front", payload_at(seq=1))
            changed = next(data for name, data in events if name == "map")
            assert changed["map_version"] > 0
            xmin, ymin, xmax, ymax = changed["changed"]
            assert xmin < xmax
            assert ymin < ymax
            token.undeclare()
            gone = next(data for name, data in events if name == "robot" and not data["alive"])
            assert gone == {"robot": "r1", "alive": False}
        status = httpx.post(f"{process.url}/v1/flush", timeout=60.0).json()
        assert status["scans_integrated"] == 1
        points = [[0.5, 1.0], [3.0, 0.3]]
        (reply,) = robot.get(
            f"{PREFIX}/_map/query",
            payload=json.dumps({"points": points}).encode(),
            encoding=JSON,
            timeout=20.0,
        )
        by_http = httpx.post(f"{process.url}/v1/query", json={"points": points}).json()
        assert json.loads(reply.ok.payload.to_bytes()) == by_http
        code, _, errors = process.end(signal.SIGTERM)
        assert code == 0, errors


def test_it_answers_before_it_has_started(tmp_path) -> None:
    """The start is held up until somebody writes to the process."""
    data = tmp_path / "data"
    with _running("--data-dir", str(data)) as process:
        process.wait_until_ready()
        process.end(signal.SIGTERM)
    port = free_port()
    hold = (
        "import sys, time, typer; from service import archive; from service.cli import serve; "
        "load = archive.Archive.load; "
        "archive.Archive.load = lambda *a: (sys.stdin.readline(), load(*a))[1]; typer.run(serve)"
    )
    flags = ("--port", str(port), "--zenoh-listen", "", "--data-dir", str(data))
    with subprocess.Popen(
        [sys.executable, "-c", hold, *flags], stdin=subprocess.PIPE, stdout=subprocess.PIPE
    ) as child:
        try:
            url = f"http://127.0.0.1:{port}"
            end_s = time.monotonic() + 60.0
            while True:
                assert time.monotonic() < end_s
                with suppress(httpx.TransportError):
                    if "being restored" in httpx.get(f"{url}/readyz").text:
                        break
                time.sleep(0.05)
            assert httpx.get(f"{url}/healthz").is_success
            assert httpx.get(f"{url}/metrics").is_success
            for path in ("/readyz", "/v1/status", "/v1/query?x=0&y=0", "/v1/events"):
                reply = httpx.get(f"{url}{path}")
                assert (reply.status_code, reply.headers["retry-after"]) == (503, "1"), path
                assert "being restored" in reply.json()["detail"]
            child.stdin.write(b"\n")
            child.stdin.flush()
            assert child.stdout.readline().startswith(b"gpom: listening")
            assert httpx.get(f"{url}/v1/status").status_code in {200, 503}
        finally:
            child.send_signal(signal.SIGTERM)
            assert child.wait(20.0) == 0


def test_a_signal_ends_a_start_that_takes_long(tmp_path) -> None:
    hold = (
        "import time, typer; from service import archive; from service.cli import serve; "
        "archive.Archive.load = lambda *a: time.sleep(600.0); typer.run(serve)"
    )
    port = free_port()
    flags = ("--port", str(port), "--zenoh-listen", "", "--data-dir", str(tmp_path / "data"))
    with subprocess.Popen([sys.executable, "-c", hold, *flags]) as child:
        try:
            end_s = time.monotonic() + 60.0
            while True:
                assert time.monotonic() < end_s
                with suppress(httpx.TransportError):
                    if httpx.get(f"http://127.0.0.1:{port}/healthz").is_success:
                        break
                time.sleep(0.05)
            start_s = time.monotonic()
            child.send_signal(signal.SIGTERM)
            assert child.wait(20.0) == 0
            assert time.monotonic() - start_s < 10.0
        finally:
            child.kill()


def test_a_signal_while_modules_are_loaded_ends_it_cleanly(tmp_path) -> None:
    flags = ("--port", "0", "--zenoh-listen", "", "--data-dir", str(tmp_path / "data"))
    child = subprocess.Popen([*COMMAND, *flags], stderr=subprocess.PIPE, text=True)
    try:
        end_s = time.monotonic() + 60.0
        while not catches(child.pid, signal.SIGTERM):
            assert time.monotonic() < end_s
            time.sleep(0.002)
        child.send_signal(signal.SIGTERM)
        _, errors = child.communicate(timeout=60.0)
        assert child.returncode == 0, errors
        assert "Traceback" not in errors
    finally:
        child.kill()


def catches(pid: int, number: signal.Signals) -> bool:
    """Whether a process has a handler for a signal."""
    status = Path(f"/proc/{pid}/status").read_text()
    (mask,) = re.findall(r"SigCgt:\s*(\w+)", status)
    return bool(int(mask, 16) >> (number - 1) & 1)


def test_a_taken_http_port_is_one_clear_line() -> None:
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = str(taken.getsockname()[1])
        done = subprocess.run(
            [*COMMAND, "--port", port, "--zenoh-listen", ""],
            capture_output=True,
            text=True,
            timeout=60.0,
            check=False,
        )
    assert done.returncode == 2
    (line,) = done.stderr.splitlines()
    assert f":{port}" in line
    assert "in use" in line


def test_a_taken_zenoh_port_is_one_clear_line() -> None:
    with socket.create_server(("127.0.0.1", 0)) as taken:
        endpoint = f"tcp/127.0.0.1:{taken.getsockname()[1]}"
        done = subprocess.run(
            [*COMMAND, "--port", "0", "--zenoh-listen", endpoint],
            capture_output=True,
            text=True,
            timeout=60.0,
            check=False,
        )
    assert done.returncode == 2
    lines = [line for line in done.stderr.splitlines() if not line.startswith("time=")]
    assert len(lines) == 1
    assert endpoint in lines[0]


def test_bad_settings_are_one_clear_line(tmp_path) -> None:
    path = tmp_path / "gpom.yaml"
    path.write_text("http: {prot: 1}")
    done = subprocess.run(
        [*COMMAND, "--config", str(path)], capture_output=True, text=True, timeout=60.0, check=False
    )
    assert done.returncode == 2
    (line,) = done.stderr.splitlines()
    assert "http.prot" in line
