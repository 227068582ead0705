"""A stand-in for the map service's HTTP interface, on a real socket of this machine."""

import io
import json
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import Any
from urllib.parse import parse_qsl, urlsplit

import numpy as np

STATUS = {
    "map_version": 7,
    "scans_received": 12,
    "scans_integrated": 11,
    "experts": 3,
    "dirty_experts": 1,
    "observations": 90,
    "robots": [
        {"id": "r1", "scans": 12, "lost": 2, "last_seen": 1.5, "pose": [1, 2, 3], "alive": True},
        {"id": "r2", "scans": 0, "lost": 0, "last_seen": None, "pose": None, "alive": False},
    ],
    "bounds": [-1.0, -2.0, 3.0, 4.0],
    "news": "of a later version",
}


class FakeHttpMap:
    """Answers as the contract says; `answers` overrides single paths."""

    def __init__(self) -> None:
        self.requests: list[dict[str, Any]] = []
        self.answers: dict[str, tuple[int, str, bytes]] = {}
        self.delay_s = 0.0
        self.url = ""

    def refuse(self, path: str, status: int, title: str, detail: str) -> None:
        problem = {"type": "about:blank", "status": status, "title": title, "detail": detail}
        self.answers[path] = (status, "application/problem+json", json.dumps(problem).encode())

    def answer(self, request: dict[str, Any]) -> tuple[int, str, bytes]:
        path, params = request["path"], request["params"]
        if path in self.answers:
            return self.answers[path]
        if path == "/v1/query" and request["method"] == "POST":
            return 200, "application/x-npy", npy(truth(np.load(io.BytesIO(request["body"]))))
        if path == "/v1/query":
            row = truth(np.array([[float(params["x"]), float(params["y"])]]))
            names = ("occupancy", "mean", "variance", "known")
            values = dict(zip(names, row.T.tolist(), strict=True))
            return 200, "application/json", json.dumps({"map_version": 7, **values}).encode()
        if path == "/v1/grid":
            return 200, "image/png", self.grid(params)
        if path in {"/v1/status", "/v1/flush"}:
            return 200, "application/json", json.dumps(STATUS).encode()
        if path == "/v1/experts":
            return 200, "application/json", json.dumps({"experts": [{"cluster_id": 1}]}).encode()
        if path == "/readyz":
            return 200, "application/json", b"{}"
        return 404, "application/json", b'{"detail": "Not Found"}'

    def grid(self, params: dict[str, str]) -> bytes:
        if params["format"] != "npy":
            return f"a {params['format']} of {params['layer']}".encode()
        xmin, ymin, xmax, ymax = map(float, params["bbox"].split(","))
        step = float(params["resolution"])
        shape = round((ymax - ymin) / step), round((xmax - xmin) / step)
        return npy(np.arange(shape[0] * shape[1], dtype=np.float64).reshape(shape))


def truth(points: np.ndarray) -> np.ndarray:
    """Columns that show which point each row belongs to."""
    x, y = points.T
    return np.column_stack((0.5 + 0 * x, x, y, x > 0))


def npy(array: np.ndarray) -> bytes:
    buffer = io.BytesIO()
    np.save(buffer, array)
    return buffer.getvalue()


@contextmanager
def running_http_map() -> Iterator[FakeHttpMap]:
    fake = FakeHttpMap()

    class Handler(BaseHTTPRequestHandler):
        protocol_version = "HTTP/1.1"

        def do_GET(self) -> None:
            split = urlsplit(self.path)
            body = self.rfile.read(int(self.headers.get("Content-Length") or 0))
            request = {
                "method": self.command,
                "path": split.path,
                "params": dict(parse_qsl(split.query)),
                "headers": dict(self.headers),
                "body": body,
            }
            fake.requests.append(request)
            time.sleep(fake.delay_s)
            status, content_type, content = fake.answer(request)
            self.send_response(status)
            self.send_header("Content-Type", content_type)
            self.send_header("Content-Length", str(len(content)))
            self.send_header("X-Gpom-Map-Version", "7")
            self.end_headers()
            self.wfile.write(content)

        do_POST = do_GET  # noqa: N815 - inherited name

        def log_message(self, format: str, *args: Any) -> None:  # noqa: A002 - inherited name
            pass

        def handle(self) -> None:
            with suppress(ConnectionError):  # a client that gave up
                super().handle()

    server = ThreadingHTTPServer(("127.0.0.1", 0), Handler)
    server.daemon_threads = True
    fake.url = f"http://127.0.0.1:{server.server_address[1]}"
    thread = threading.Thread(target=server.serve_forever, kwargs={"poll_interval": 0.02})
    thread.start()
    try:
        yield fake
    finally:
        server.shutdown()
        thread.join()
        server.server_close()
