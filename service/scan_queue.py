"""The bounded queue between the threads of a source and the thread that decodes."""

import threading
from collections import deque

from service.settings import QueuePolicy
from service.source import Envelope


class ScanQueue:
    """First in, first out, bounded in scans and in bytes; what happens when full has a name.

    Every scan that enters gets a ticket, 1, 2, 3, …: `entered` is the last one given, so
    whoever wants to know whether everything up to now was handled remembers `entered`.
    """

    def __init__(self, policy: QueuePolicy, scans_max: int, bytes_max: int) -> None:
        self._policy = policy
        self._scans_max = scans_max
        self._bytes_max = bytes_max
        self._items: deque[Envelope] = deque()
        self._bytes = 0
        self._entered = 0
        self._dropped = 0
        self._received = 0
        self._closed = False
        self._changed = threading.Condition()

    @property
    def received(self) -> int:
        """Scans that arrived, whatever became of them."""
        return self._received

    @property
    def entered(self) -> int:
        """The last ticket."""
        return self._entered

    @property
    def dropped(self) -> int:
        """Scans that the policy threw away."""
        return self._dropped

    @property
    def closed(self) -> bool:
        """Whether it takes no more scans."""
        return self._closed

    def __len__(self) -> int:
        """Scans that wait."""
        return len(self._items)

    def put(self, envelope: Envelope) -> bool:
        """Add a scan. Blocks while full if that is the policy.

        Returns:
            Whether the scan is in the queue: not when the newest is dropped, or it is closed.
        """
        size = len(envelope.payload)
        with self._changed:
            self._received += 1
            if self._policy == "block":
                self._changed.wait_for(lambda: self._closed or self._fits(size))
            elif self._policy == "drop_oldest":
                while self._items and not self._fits(size):
                    self._bytes -= len(self._items.popleft().payload)
                    self._dropped += 1
            if self._closed or not self._fits(size):
                self._dropped += 1
                return False
            self._items.append(envelope)
            self._bytes += size
            self._entered += 1
            self._changed.notify_all()
            return True

    def take(self, limit: int, timeout_s: float | None = None) -> tuple[list[Envelope], int]:
        """Wait for scans and remove up to `limit` of them.

        Returns:
            The scans, and the ticket of the last one. No scans: it is closed and empty, or they
            did not come within `timeout_s`.
        """
        with self._changed:
            self._changed.wait_for(lambda: self._closed or self._items, timeout_s)
            taken = [self._items.popleft() for _ in range(min(limit, len(self._items)))]
            self._bytes -= sum(len(envelope.payload) for envelope in taken)
            self._changed.notify_all()
            return taken, self._entered - len(self._items)

    def close(self) -> None:
        """Take no more scans; those inside can still be taken out."""
        with self._changed:
            self._closed = True
            self._changed.notify_all()

    def _fits(self, size: int) -> bool:
        # An empty queue takes any scan: one that is larger than the bound must not wait for ever.
        if not self._items:
            return True
        return len(self._items) < self._scans_max and self._bytes + size <= self._bytes_max
