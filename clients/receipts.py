"""What became of scans, told to who asked: futures for single scans, a callback for all.

A thread of its own tells, and holds no lock while it does. So whoever is told may publish, wait or
fail, and keeps neither the outbox from sending nor others from hearing.
"""

import logging
import threading
from collections import deque
from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import Future
from typing import NamedTuple

from clients.errors import DeliveryError, ScanDroppedError, UnknownScanError

_REMEMBERED = 4096  # scans that were dropped

_logger = logging.getLogger(__name__)


class _News(NamedTuple):
    """What became of a scan: stored, unless there is an error."""

    ticket: int
    futures: Sequence["Future[int]"]
    error: DeliveryError | None


class Receipts:
    """Who waits to hear of scans, and the thread that tells them, in the order of the news.

    Args:
        stream: whose scans they are, for the log.
        before: what became of scans up to this ticket is not known here.
        dropped: tickets after it, ascending, of scans that were dropped.
        on_durable: told the ticket of every scan that is stored.
        remembered: how many dropped scans are told from stored ones when asked about later.
    """

    def __init__(
        self,
        stream: str,
        before: int = 0,
        dropped: Iterable[int] = (),
        *,
        on_durable: Callable[[int], None] | None = None,
        remembered: int = _REMEMBERED,
    ) -> None:
        self._stream = stream
        self._forgotten = before
        self._on_durable = on_durable
        self._dropped: deque[int] = deque(maxlen=remembered)
        self._waiting: dict[int, list[Future[int]]] = {}
        self._news: deque[_News] = deque()
        self._came = self._told = 0  # news so far
        self._closed = False
        self._changed = threading.Condition()
        self._thread: threading.Thread | None = None
        for ticket in dropped:
            self._remember(ticket)
        if on_durable is not None:
            self._start()

    def promise(self, ticket: int) -> "Future[int]":
        """Give a future of a scan that is neither stored nor dropped yet; each call its own."""
        future: Future[int] = Future()
        with self._changed:
            self._start()
            # Who asks again after each timeout must not pile up what was cancelled.
            waiting = [other for other in self._waiting.get(ticket, ()) if not other.cancelled()]
            self._waiting[ticket] = [*waiting, future]
        return future

    def past(self, ticket: int, first: int, last: int) -> "Future[int]":
        """Give a future, done already, of a scan that waits no more.

        Args:
            ticket: of the scan.
            first: ticket of the first scan that waits; `last + 1` when none does.
            last: ticket of the last scan that was taken.

        Raises:
            UnknownScanError: no scan has that number, or it is of too long ago.
        """
        with self._changed:
            dropped, forgotten = ticket in self._dropped, self._forgotten
        if not dropped and not forgotten < ticket <= last:
            first = min(first, forgotten + 1)
            expected = f"expected a number from {first} to {last}"
            known = expected if first <= last else "none was published yet"
            raise UnknownScanError(f"no scan {ticket} is known here; {known}")
        return settled(ticket, _dropped(ticket) if dropped else None)

    def stored(self, tickets: Iterable[int]) -> None:
        """Tell that scans are stored."""
        self._add(tickets, None)

    def dropped(self, ticket: int) -> None:
        """Tell that a scan made room. They are dropped in order."""
        with self._changed:
            self._remember(ticket)
        self._add([ticket], _dropped(ticket))

    def fail_all(self, error: DeliveryError) -> None:
        """Tell all who wait that nothing comes of it."""
        with self._changed:
            self._add(sorted(self._waiting), error)

    def wait(self, timeout_s: float) -> None:
        """Wait until the news that came so far are told."""
        if threading.current_thread() is self._thread:
            return  # a callback would wait for itself
        with self._changed:
            came = self._came
            self._changed.wait_for(lambda: self._told >= came, timeout_s)

    def close(self, timeout_s: float) -> None:
        """Wait until all news are told; what takes longer is told later. No more may come."""
        with self._changed:
            self._closed = True
            self._changed.notify_all()
        if self._thread is not None and threading.current_thread() is not self._thread:
            self._thread.join(timeout_s)

    def _remember(self, dropped: int) -> None:
        if len(self._dropped) == self._dropped.maxlen:
            self._forgotten = self._dropped[0]
        self._dropped.append(dropped)

    def _start(self) -> None:
        if self._thread is None:
            thread = threading.Thread(target=self._run, name=f"gpom-receipts-{self._stream}")
            thread.daemon = True  # a callback that hangs must not hold the process
            thread.start()
            self._thread = thread

    def _add(self, tickets: Iterable[int], error: DeliveryError | None) -> None:
        with self._changed:
            for ticket in tickets:
                futures = self._waiting.pop(ticket, ())
                if futures or (error is None and self._on_durable is not None):
                    self._news.append(_News(ticket, futures, error))
                    self._came += 1
            self._changed.notify_all()

    def _run(self) -> None:
        while True:
            with self._changed:
                self._changed.wait_for(lambda: self._news or self._closed)
                if not self._news:
                    return
                news = self._news.popleft()
            self._tell(news)
            with self._changed:
                self._told += 1
                self._changed.notify_all()

    def _tell(self, news: _News) -> None:
        # Whatever one of them raises, even SystemExit, the others are told.
        for future in news.futures:
            try:
                _settle(news, future)
            except BaseException:
                _logger.exception("cannot tell of scan %d of %s", news.ticket, self._stream)
        if news.error is None and self._on_durable is not None:
            try:
                self._on_durable(news.ticket)
            except BaseException:
                _logger.exception("on_durable failed for scan %d of %s", news.ticket, self._stream)


def settled(ticket: int, error: DeliveryError | None) -> "Future[int]":
    """Give a future that is done: with the ticket, or the error if there is one."""
    future: Future[int] = Future()
    _settle(_News(ticket, (), error), future)
    return future


def _dropped(ticket: int) -> ScanDroppedError:
    return ScanDroppedError(f"scan {ticket} made room for later ones")


def _settle(news: _News, future: "Future[int]") -> None:
    if future.done() and not future.cancelled():
        return  # somebody else completed it
    if not future.set_running_or_notify_cancel():
        return  # cancelled; otherwise it cannot be from here on
    if news.error is None:
        future.set_result(news.ticket)
    else:
        # Its own: a traceback grows with every raise.
        future.set_exception(type(news.error)(*news.error.args))
