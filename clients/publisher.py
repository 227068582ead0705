"""The stream of scans from one sensor of one robot to the map."""

import logging
import threading
import time
from collections.abc import Callable, Sequence
from concurrent.futures import Future
from contextlib import ExitStack
from dataclasses import replace
from types import TracebackType
from typing import Protocol, Self

import zenoh

from clients.errors import DeliveryError
from clients.keys import DEFAULT_ENDPOINT, DEFAULT_PREFIX, StreamKeys
from clients.link import Parcel, ScanLink, SessionSettings, open_session
from clients.outbox import OutboxSettings
from clients.reliable import ReliableLink
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

    def send(self, parcel: Parcel) -> int:
        """Take a parcel on its way; give the number by which the sender knows it."""
        ...

    def drain(self, timeout_s: float) -> bool:
        """Wait until all parcels are through; False when they are not in time."""
        ...

    def close(self) -> None:
        """Let go of the network."""
        ...


class ScanPublisher:
    """Publishes the scans of one sensor of one robot, in order and numbered.

    Use it as a context manager. Entering opens the session (or borrows the given one), announces
    the robot and starts a stream; leaving waits up to `CLOSE_TIMEOUT_S` for scans under way.
    `publish` may be called from several threads.

    Reliable delivery, the default, keeps scans in an outbox until the map has stored them, over
    any restart of the map or the network; with `OutboxSettings(path=…)` over those of the robot
    too. Best effort sends each scan once.

    Args:
        robot: name of the robot, one chunk of a zenoh key.
        sensor: name of the sensor, likewise.
        prefix: of the site's keys.
        endpoints: zenoh routers to connect to; unused with a session.
        session: an open session to borrow; several publishers may share one.
        clock_ns: gives the time that tells this stream from earlier ones.
        reliable: whether scans are kept until they are stored.
        outbox: how they are kept.
        on_durable: told the number of every scan that the map has stored, in order, by a thread
            that does nothing else. It may publish; what it raises is logged.

    Raises:
        ConfigurationError: a name or an endpoint is malformed.
        DeliveryError: on entering, no router answers, or the outbox on disk cannot be used.
    """

    def __init__(  # noqa: PLR0913 - all but the names are by keyword
        self,
        robot: str,
        sensor: str = DEFAULT_SENSOR,
        *,
        prefix: str = DEFAULT_PREFIX,
        endpoints: Sequence[str] = (DEFAULT_ENDPOINT,),
        session: zenoh.Session | None = None,
        clock_ns: Callable[[], int] = time.time_ns,
        reliable: bool = True,
        outbox: OutboxSettings | None = None,
        on_durable: Callable[[int], None] | None = None,
    ) -> None:
        self.keys = StreamKeys(prefix, robot, sensor)
        self._settings = SessionSettings(endpoints=endpoints)
        self._borrowed = session
        self._clock_ns = clock_ns
        self.reliable = reliable
        self._outbox = outbox or OutboxSettings()
        self._on_durable = on_durable
        self._keeper: ReliableLink | None = None
        self._lock = threading.Lock()
        self._stack = ExitStack()
        self._outlet: Outlet | None = None
        self._boot = 0
        self._seq = 0

    def __enter__(self) -> Self:
        with ExitStack() as stack:
            session = self._borrowed or stack.enter_context(open_session(self._settings))
            self._boot, self._seq = self._clock_ns(), 0
            if self.reliable:
                self._keeper = stack.enter_context(
                    ReliableLink(session, self.keys, self._boot, self._outbox, self._on_durable)
                )
                self._outlet, self._seq = self._keeper, self._keeper.ticket
            else:
                self._outlet = stack.enter_context(ScanLink(session, self.keys))
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
            self._warn_of_the_rest()
        self._keeper = None
        self._stack.close()

    def _warn_of_the_rest(self) -> None:
        if self._keeper is None:
            _logger.warning("the last scans of %s may be lost: nobody took them", self.keys.scan)
        elif self._outbox.path is None:
            _logger.warning("%d scans of %s are not stored", self._keeper.waiting, self.keys.scan)
        else:
            _logger.info(
                "%d scans of %s wait in %s", self._keeper.waiting, self.keys.scan, self._outbox.path
            )

    @property
    def boot(self) -> int:
        """Which stream it is: its start, ns since the epoch, or what follows the one before."""
        return self._boot if self._keeper is None else self._keeper.boot

    @property
    def waiting(self) -> int:
        """Scans in the outbox: the map has not stored them yet."""
        return 0 if self._keeper is None else self._keeper.waiting

    @property
    def dropped(self) -> int:
        """Scans that the outbox dropped, as its policy says."""
        return 0 if self._keeper is None else self._keeper.dropped

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
        """How often reception ended; best effort may then have lost what was under way."""
        return self._open_outlet().interruptions

    def wait_ready(self, timeout_s: float = 10.0) -> None:
        """Wait until a map service receives this stream. Best effort loses scans published before.

        Raises:
            DeliveryError: none does within `timeout_s`.
        """
        self._open_outlet().wait_ready(timeout_s)

    def publish(self, scan: Scan) -> int:
        """Send a scan as the next of the stream; its own boot, seq and reliable are replaced.

        Best effort blocks while the receiver is busy, reliable delivery while the outbox is full
        if that is its policy. Returning is not delivery; see `durable`.

        Returns:
            Its number: that in the stream, unless the outbox dropped some or began a new run.

        Raises:
            OutboxFullError: no room in the time that the outbox may block.
            ScanDroppedError: no room, and nothing older to drop.
            SupersededError: another publisher has taken over this robot's name.
            DeliveryError: the publisher is not open.
        """
        outlet = self._open_outlet()
        with self._lock:
            seq = self._seq + 1
            numbered = replace(scan, boot=self._boot, seq=seq, reliable=self.reliable)
            self._seq = outlet.send(Parcel(seq, encode(numbered)))
            return self._seq

    def durable(self, number: int) -> "Future[int]":
        """Give a future that is done when the map has stored the scan that `publish` gave a number.

        In asyncio: ``await asyncio.wrap_future(publisher.durable(number))``. Each call gives a
        future of its own, which may be cancelled. It fails with ScanDroppedError, with
        SupersededError when another publisher takes over the robot's name, and with DeliveryError
        when this one is closed before.

        Raises:
            UnknownScanError: no scan has that number, or it was through before this publisher was
                opened; a ValueError too.
            DeliveryError: delivery is best effort, or the publisher is not open.
        """
        self._open_outlet()
        if self._keeper is None:
            raise DeliveryError(
                "best-effort delivery never knows; use ScanPublisher(reliable=True)"
            )
        return self._keeper.durable(number)

    def drain(self, timeout_s: float = CLOSE_TIMEOUT_S) -> bool:
        """Wait until the map has stored all that was published; False when it takes longer.

        With best effort: until all has left this machine.
        """
        return self._open_outlet().drain(timeout_s)

    def _open_outlet(self) -> Outlet:
        if self._outlet is None:
            message = f"the publisher of {self.keys.scan} is not open; use it in a `with` block"
            raise DeliveryError(message)
        return self._outlet
