"""A small pool for heavy queries that says no instead of letting a line grow without end."""

import threading
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from typing import TypeVar

from service.errors import BusyError, StoppingError
from service.priority import be_nice

_T = TypeVar("_T")

_NICE = 5  # after scans and single points, before training


class QueryDesk:
    """Runs at most `threads` calls at once, and lets at most `waiting_max` wait."""

    def __init__(
        self, threads: int, waiting_max: int, retry_after_s: int, name: str = "gpom-query"
    ) -> None:
        self._places = threads + waiting_max
        self._retry_after_s = retry_after_s
        self._taken = 0
        self._lock = threading.Lock()
        self._closing = False
        self._pool = ThreadPoolExecutor(threads, name, initializer=be_nice, initargs=(_NICE,))

    @property
    def taken(self) -> int:
        """Calls that run or wait."""
        return self._taken

    def submit(self, call: Callable[[], _T]) -> "Future[_T]":
        """Run a call soon.

        Raises:
            BusyError: too many wait already.
            StoppingError: the desk is closed.
        """
        with self._lock:
            if self._taken >= self._places:
                message = f"{self._taken} heavy queries are running or waiting; try again later"
                raise BusyError(message, self._retry_after_s)
            self._taken += 1
        try:
            future = self._pool.submit(call)
        except RuntimeError as error:
            self._leave()
            raise StoppingError("the service is shutting down") from error
        future.add_done_callback(lambda _: self._leave())
        return future

    def check(self) -> None:
        """Let a call that runs for long end with the service.

        Raises:
            StoppingError: it is time.
        """
        if self._closing:
            raise StoppingError("the service is shutting down")

    def close(self) -> None:
        """Take no more calls, forget those that did not start, end those that check."""
        self._closing = True
        self._pool.shutdown(wait=False, cancel_futures=True)

    def _leave(self) -> None:
        with self._lock:
            self._taken -= 1
