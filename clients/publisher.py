"""The stream of scans from one sensor of one robot to the map."""

import logging
import threading
import time
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from dataclasses import replace
from types import TracebackType
from typing import Protocol, Self

import zenoh

from clients.errors import DeliveryError
from clients.keys import DEFAULT_ENDPOINT, DEFAULT_PREFIX, StreamKeys
from clients.link import Parcel, ScanLink, SessionSettings, open_session
from gpom_core.scan import Scan
from gpom_core.wire import encode

DEFAULT_SENSOR = "laser"
CLOSE_TIMEOUT_S = 5.0

_logger = logging.getLogger(__name__)


class Outlet(Protocol):
    """Where numbered scans go: straight to zenoh, or into an outbox that repeats them."""

    @property
    def ready(self) -> bool:
        """Whether a map service receives what is sent now."""
        ...

    @property
    def interruptions(self) -> int:
        """How often reception ended."""
        ...

    def wait_ready(self, timeout_s: float) -> None:
        """Wait until a map service receives; raise DeliveryError when none does in time."""
        ...

    def send(self, parcel: Parcel) -> None:
        """Take a parcel on its way."""
        ...

    def drain(self, timeout_s: float) -> bool:
        """Wait until all parcels are through; False when they are not in time."""
        ...

    def close(self) -> None:
        """Let go of the network."""
        ...


class ScanPublisher:
    """Publishes the scans of one sensor of one robot, best effort, in order and numbered.

    Use it as a context manager. Entering opens the session (or borrows the given one), announces
    the robot and starts a stream; leaving waits up to `CLOSE_TIMEOUT_S` for scans under way.
    `publish` may be called from several threads.

    Args:
        robot: name of the robot, one chunk of a zenoh key.
        sensor: name of the sensor, likewise.
        prefix: of the site's keys.
        endpoints: zenoh routers to connect to; unused with a session.
        session: an open session to borrow; several publishers may share one.
        clock_ns: gives the time that tells this stream from earlier ones.

    Raises:
        ConfigurationError: a name or an endpoint is malformed.
        DeliveryError: on entering, no router answers.
    """

    def __init__(
        self,
        robot: str,
        sensor: str = DEFAULT_SENSOR,
        *,
        prefix: str = DEFAULT_PREFIX,
        endpoints: Sequence[str] = (DEFAULT_ENDPOINT,),
        session: zenoh.Session | None = None,
        clock_ns: Callable[[], int] = time.time_ns,
    ) -> None:
        self.keys = StreamKeys(prefix, robot, sensor)
        self._settings = SessionSettings(endpoints=endpoints)
        self._borrowed = session
        self._clock_ns = clock_ns
        self._lock = threading.Lock()
        self._stack = ExitStack()
        self._outlet: Outlet | None = None
        self._boot = 0
        self._seq = 0

    def __enter__(self) -> Self:
        with ExitStack() as stack:
            session = self._borrowed or stack.enter_context(open_session(self._settings))
            self._outlet = stack.enter_context(ScanLink(session, self.keys))
            self._boot, self._seq = self._clock_ns(), 0
            self._stack = stack.pop_all()
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        outlet, self._outlet = self._outlet, None
        # After an error nobody wants to wait.
        if outlet is not None and self._seq and error is None and not outlet.drain(CLOSE_TIMEOUT_S):
            _logger.warning("the last scans of %s may be lost: nobody took them", self.keys.scan)
        self._stack.close()

    @property
    def boot(self) -> int:
        """Start of the stream, ns since the epoch."""
        return self._boot

    @property
    def seq(self) -> int:
        """Number of the last scan published; 0 before the first."""
        return self._seq

    @property
    def ready(self) -> bool:
        """Whether a map service receives what is published now."""
        return self._open_outlet().ready

    @property
    def interruptions(self) -> int:
        """How often reception ended; scans under way then may be lost."""
        return self._open_outlet().interruptions

    def wait_ready(self, timeout_s: float = 10.0) -> None:
        """Wait until a map service receives this stream. Scans published before are lost.

        Raises:
            DeliveryError: none does within `timeout_s`.
        """
        self._open_outlet().wait_ready(timeout_s)

    def publish(self, scan: Scan) -> int:
        """Send a scan as the next of the stream; its own boot, seq and reliable are replaced.

        Blocks while the receiver is busy. Returning is not delivery.

        Returns:
            The sequence number it got.

        Raises:
            DeliveryError: the publisher is not open.
        """
        outlet = self._open_outlet()
        with self._lock:
            seq = self._seq + 1
            numbered = replace(scan, boot=self._boot, seq=seq, reliable=False)
            outlet.send(Parcel(seq, encode(numbered)))
            self._seq = seq
        return seq

    def drain(self, timeout_s: float = CLOSE_TIMEOUT_S) -> bool:
        """Wait until all that was published has left this machine; False when it takes longer."""
        return self._open_outlet().drain(timeout_s)

    def _open_outlet(self) -> Outlet:
        if self._outlet is None:
            message = f"the publisher of {self.keys.scan} is not open; use it in a `with` block"
            raise DeliveryError(message)
        return self._outlet
