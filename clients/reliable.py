"""Delivery that loses nothing: what the map has not acknowledged is kept, and sent again.

One thread sends. It begins by asking the map where the stream is, sends from there, and asks again
whenever there was no progress for a second. The map stores scans in order and once, so sending
twice does no harm.
"""

import logging
import threading
import time
from collections import deque
from collections.abc import Callable
from concurrent.futures import Future
from types import TracebackType
from typing import Self

import zenoh

from clients.cursors import ASK_TIMEOUT_S, Cursor, Cursors, Unknown
from clients.errors import (
    DeliveryError,
    OutboxFullError,
    ScanDroppedError,
    SupersededError,
)
from clients.keys import StreamKeys
from clients.link import Parcel, ScanLink
from clients.outbox import DiskStore, MemoryStore, OutboxSettings, Store
from clients.receipts import Receipts, settled
from gpom_core.wire import renumber

_TELL_TIMEOUT_S = 3.0
_RETRY_S = 0.2
_ASK_AGAIN_S = 0.05  # while it is not known where the stream is; the first scan waits for that
_STUCK_S = 10.0

_logger = logging.getLogger(__name__)


class ReliableLink:
    """An outbox in front of a `ScanLink`.

    Args:
        session: open; it is not closed here.
        keys: of the stream.
        boot: of the run, unless the outbox on disk goes on with an older one.
        settings: of the outbox.
        on_durable: told the ticket of every scan that the map has stored, in order, by a thread
            that does nothing else. What it raises is logged.
    """

    def __init__(
        self,
        session: zenoh.Session,
        keys: StreamKeys,
        boot: int,
        settings: OutboxSettings,
        on_durable: Callable[[int], None] | None = None,
    ) -> None:
        self._keys = keys
        self._settings = settings
        self._store: Store = (
            MemoryStore(boot)
            if settings.path is None
            else DiskStore(settings.path, f"{keys.robot}/{keys.sensor}", boot)
        )
        self._sent = len(self._store)  # entries that may be on their way: they keep their numbers
        self._next = 0  # place in the queue of the entry to send
        self._synced = False
        self._progress_s = time.monotonic()
        self._stuck_since_s: float | None = None
        self._acks: deque[Cursor] = deque()
        self._dropped = 0
        self._superseded: str | None = None
        self._closing = False
        self._changed = threading.Condition()
        self._link = ScanLink(session, keys)
        self._cursors = Cursors(session, keys, self._on_ack)
        before, dropped = self._store.front - 1, self._store.dropped()
        self._receipts = Receipts(keys.scan, before, dropped, on_durable=on_durable)
        self._thread = threading.Thread(target=self._run, name=f"gpom-outbox-{keys.robot}")
        self._thread.daemon = True  # a put that hangs must not hold the process
        self._thread.start()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self.close()

    @property
    def ready(self) -> bool:
        """Whether a map service receives what is sent now."""
        return self._link.ready

    @property
    def interruptions(self) -> int:
        """How often reception ended. Nothing is lost by it."""
        return self._link.interruptions

    @property
    def boot(self) -> int:
        """Of the run that is being sent."""
        return self._store.boot

    @property
    def waiting(self) -> int:
        """Scans that the map has not acknowledged."""
        return len(self._store)

    @property
    def dropped(self) -> int:
        """Scans that the policy dropped."""
        return self._dropped

    @property
    def ticket(self) -> int:
        """Of the last scan that was taken."""
        return self._store.ticket

    def wait_ready(self, timeout_s: float) -> None:
        """Wait until a map service receives.

        Raises:
            DeliveryError: none does in time.
        """
        self._link.wait_ready(timeout_s)

    def send(self, parcel: Parcel) -> int:
        """Take a scan, whatever its number; it is sent with the next one of the stream.

        Returns:
            Its ticket: 1, 2, 3, … in this outbox.

        Raises:
            OutboxFullError: there was no room in time.
            DeliveryError: the link is closed, or another publisher has the robot's name.
        """
        with self._changed:
            self._make_room(len(parcel.payload))
            entry = self._store.add(parcel.payload)
            self._changed.notify_all()
            return entry.ticket

    def durable(self, ticket: int) -> "Future[int]":
        """Give a future that is done when the map has stored a scan; each call its own.

        `asyncio.wrap_future` makes it awaitable. It fails with ScanDroppedError, SupersededError,
        or DeliveryError when the link is closed before.

        Raises:
            UnknownScanError: no scan has that ticket, or what became of it is not known any more.
        """
        with self._changed:
            if not self._store.has(ticket):
                return self._receipts.past(ticket, self._store.front, self._store.ticket)
            refusal = self._refusal()
            return settled(ticket, refusal) if refusal else self._receipts.promise(ticket)

    def drain(self, timeout_s: float) -> bool:
        """Wait until the map has stored all that was taken; False when that takes longer.

        Who asked is told as well by then, if that takes no longer.
        """
        end_s = time.monotonic() + timeout_s
        with self._changed:
            self._changed.wait_for(lambda: len(self._store) == 0 or self._over(), timeout_s)
            if len(self._store) > 0:
                return False
        self._receipts.wait(end_s - time.monotonic())
        return True

    def close(self) -> None:
        """Stop sending. What waits is kept on disk, or lost if there is none."""
        with self._changed:
            self._closing = True
            self._changed.notify_all()
        self._cursors.close()
        self._link.close()
        self._thread.join(ASK_TIMEOUT_S + 1.0)
        with self._changed:
            self._store.close()
            message = f"the publisher of {self._keys.scan} was closed before it was stored"
            self._receipts.fail_all(DeliveryError(message))
        self._receipts.close(_TELL_TIMEOUT_S)

    def _make_room(self, size: int) -> None:
        self._refuse_if_over()
        if self._fits(size):
            return
        if self._settings.policy == "drop_oldest":
            self._drop_oldest(size)
            return
        timeout_s = self._settings.block_timeout_s
        self._changed.wait_for(lambda: self._over() or self._fits(size), timeout_s)
        self._refuse_if_over()
        if not self._fits(size):
            message = (
                f"{len(self._store)} scans of {self._keys.scan} wait, which is all there is room "
                f"for, and the map took none within {timeout_s:g} s"
            )
            raise OutboxFullError(message)

    def _drop_oldest(self, size: int) -> None:
        # What may be on its way keeps its number, so it cannot be dropped.
        while not self._fits(size) and len(self._store) > self._sent:
            dropped = self._store.remove_at(self._sent)
            self._dropped += 1
            self._receipts.dropped(dropped.ticket)
        if not self._fits(size):
            self._dropped += 1
            message = "the outbox is full of scans that are on their way; this one is dropped"
            raise ScanDroppedError(message)

    def _fits(self, size: int) -> bool:
        store = self._store
        if len(store) == 0:
            return True  # one that is larger than the bound must not wait for ever
        return (
            len(store) < self._settings.scans_max
            and store.size_bytes + size <= self._settings.bytes_max
        )

    def _over(self) -> bool:
        return self._superseded is not None or self._closing

    def _refusal(self) -> DeliveryError | None:
        if self._superseded is not None:
            return SupersededError(self._superseded)
        if self._closing:
            return DeliveryError(f"the publisher of {self._keys.scan} is closed")
        return None

    def _refuse_if_over(self) -> None:
        refusal = self._refusal()
        if refusal is not None:
            raise refusal

    def _on_ack(self, cursor: Cursor) -> None:
        with self._changed:
            self._acks.append(cursor)
            self._changed.notify_all()

    def _run(self) -> None:
        while True:
            try:
                if not self._step():
                    return
            except DeliveryError as error:
                if not self._closing:
                    _logger.warning("%s; trying again", error)
                    time.sleep(_RETRY_S)
            except Exception:
                _logger.exception("unexpected error in the outbox of %s", self._keys.scan)
                time.sleep(_RETRY_S)

    def _step(self) -> bool:
        with self._changed:
            patience_s = self._settings.silence_s / 4 if self._synced else _ASK_AGAIN_S
            self._changed.wait_for(self._has_work, patience_s)
            if self._over():
                return False
            while self._acks and not self._over():
                self._absorb(self._acks.popleft())
            self._watch_silence()
            synced = self._synced
            parcels = self._due() if synced and self._link.ready else []
        if not synced:
            self._synchronise()
        for parcel in parcels:
            self._link.send(parcel)
        return True

    def _has_work(self) -> bool:
        return self._over() or bool(self._acks) or (self._synced and self._next < self._limit())

    def _limit(self) -> int:
        return min(len(self._store), self._settings.window)

    def _watch_silence(self) -> None:
        now_s = time.monotonic()
        if len(self._store) == 0:
            self._progress_s, self._stuck_since_s = now_s, None
        elif now_s - self._progress_s > self._settings.silence_s:
            self._progress_s, self._synced = now_s, False
            if self._stuck_since_s is None:
                self._stuck_since_s = now_s
            elif now_s - self._stuck_since_s > _STUCK_S and self._link.ready:
                self._stuck_since_s = now_s
                _logger.warning(
                    "the map has not stored scan %d of %s for %g s: it may be busy, or refuse it "
                    "(see gpom_scans_refused in its metrics)",
                    self._store.acked + 1,
                    self._keys.scan,
                    _STUCK_S,
                )

    def _due(self) -> list[Parcel]:
        """Take what may be sent now; from here on it may be on its way."""
        store, start = self._store, self._next
        entries = store.slice(start, min(self._limit(), start + 32))
        self._next += len(entries)
        self._sent = max(self._sent, self._next)
        if entries and start == 0:
            self._progress_s = time.monotonic()
        first = store.acked + 1 + start
        return [
            Parcel(first + i, renumber(entry.payload, store.boot, first + i))
            for i, entry in enumerate(entries)
        ]

    def _synchronise(self) -> None:
        if not self._link.ready:
            time.sleep(0.02)
            return
        answer = self._cursors.ask()
        with self._changed:
            if answer is Unknown.MAP or self._over():
                return
            if isinstance(answer, Cursor):
                self._absorb(answer)
                if self._over():
                    return
            if self._store.acked > 0 and not (
                isinstance(answer, Cursor) and answer.boot == self._store.boot
            ):
                # It had stored scans and knows them no more, so it would wait for number 1.
                self._restart(self._store.boot + 1)
            self._next, self._synced = 0, True
            self._progress_s = time.monotonic()

    def _absorb(self, cursor: Cursor) -> None:
        """Take note of what is stored."""
        store = self._store
        if cursor.boot > store.boot:
            if store.acked > 0:
                self._superseded = (
                    f"another publisher has taken over {self._keys.scan}: two robots have the "
                    f"same name. {len(store)} scans of this one are not stored"
                )
                _logger.error(self._superseded)
                self._receipts.fail_all(SupersededError(self._superseded))
                self._changed.notify_all()
            else:
                self._restart(cursor.boot + 1)  # this machine's clock is behind the last run's
            return
        count = min(cursor.seq - store.acked, len(store)) if cursor.boot == store.boot else 0
        if count <= 0:
            return
        done = store.remove_front(count)
        self._next, self._sent = max(self._next - count, 0), max(self._sent - count, 0)
        self._progress_s, self._stuck_since_s = time.monotonic(), None
        self._receipts.stored(entry.ticket for entry in done)
        self._changed.notify_all()

    def _restart(self, boot: int) -> None:
        self._store.restart(boot)
        self._next = 0
