"""The port by which scans, queries and signs of life of robots arrive, with an in-memory fake."""

from collections.abc import Callable
from concurrent.futures import Future
from dataclasses import dataclass, field
from typing import Protocol

from service.errors import SourceError
from service.fleet import IntakeStatus
from service.sequences import Cursor


@dataclass(frozen=True, slots=True)
class Envelope:
    """A scan as it came in: not yet decoded, not yet trusted."""

    robot: str
    sensor: str
    payload: bytes
    received_unix_s: float


@dataclass(frozen=True, slots=True)
class RemoteReply:
    """What a remote query gets back: an answer, or the problem with it."""

    body: bytes
    media_type: str
    is_error: bool = False


@dataclass(frozen=True, slots=True)
class RemoteQuery:
    """A question about points from somewhere other than HTTP.

    Attributes:
        body: the points, JSON or npy as `media_type` says.
        media_type: of the body; empty when unknown.
        fusion: the rule asked for beside the body, or None.
        reply: to be called exactly once, from any thread.
        method: asked for beside the body, or None.
    """

    body: bytes
    media_type: str
    fusion: str | None
    reply: Callable[[RemoteReply], None]
    method: str | None = None


class SourceSink(Protocol):
    """Where a source delivers. Called from threads of the source; never raises."""

    def on_scan(self, robot: str, sensor: str, payload: bytes) -> None:
        """A scan arrived. May block: that is what slows robots down."""

    def on_presence(self, robot: str, alive: bool) -> None:
        """A robot came, or went."""

    def on_query(self, query: RemoteQuery) -> None:
        """Somebody asks; the reply comes later."""

    def on_intake(self, robot: str, status: IntakeStatus) -> None:
        """Scans that come without a pose fare so, before they arrive as scans."""

    def on_refused(self, reason: str, count: int) -> None:
        """So many scans were refused before they arrived as scans, of robots without a status."""

    def cursor(self, robot: str, sensor: str) -> Cursor | None:
        """Give the last stored scan of a sensor; None if there is none."""
        ...


class ScanSource(Protocol):
    """A way by which scans arrive."""

    def open(self, sink: SourceSink) -> None:
        """Start to deliver.

        Raises:
            SourceError: it cannot be opened; says why.
        """

    def close(self) -> None:
        """Stop to deliver; nothing is called on the sink afterwards. May be called twice."""

    def trouble(self) -> str | None:
        """Why nothing can arrive at the moment; None when all is well."""

    def endpoints(self) -> tuple[str, ...]:
        """Where robots can reach it."""


@dataclass(slots=True)
class MemorySource:
    """A source whose scans are put in by hand, for tests and embedding."""

    _sink: SourceSink | None = field(default=None, init=False)

    def open(self, sink: SourceSink) -> None:
        """Start to deliver to `sink`."""
        self._sink = sink

    def close(self) -> None:
        """Stop to deliver."""
        self._sink = None

    def trouble(self) -> str | None:
        """Say so when it is closed."""
        return None if self._sink is not None else "the in-memory source is closed"

    def endpoints(self) -> tuple[str, ...]:
        """None: it is reached by reference."""
        return ()

    def put(self, robot: str, sensor: str, payload: bytes) -> None:
        """Deliver a scan."""
        self._opened().on_scan(robot, sensor, payload)

    def set_alive(self, robot: str, alive: bool) -> None:
        """Let a robot come or go."""
        self._opened().on_presence(robot, alive)

    def ask(self, body: bytes, media_type: str, fusion: str | None = None) -> Future[RemoteReply]:
        """Ask about points."""
        future: Future[RemoteReply] = Future()
        self._opened().on_query(RemoteQuery(body, media_type, fusion, future.set_result))
        return future

    def _opened(self) -> SourceSink:
        if self._sink is None:
            raise SourceError("the in-memory source is closed; open it first")
        return self._sink
