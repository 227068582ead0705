"""Rasters that were drawn, kept for those who ask again and again.

One that is still the newest is given as it is. Who allows some age gets the last one at once, while
the next is drawn behind it: under load drawing takes as long as the map stays the same.
"""

import threading
from collections import OrderedDict
from collections.abc import Callable, Hashable
from concurrent.futures import Future
from dataclasses import dataclass
from functools import partial

from service.clock import Clock
from service.errors import BusyError
from service.query_desk import QueryDesk


@dataclass(frozen=True, slots=True)
class Raster:
    """A drawn raster.

    Attributes:
        map_version: that it was drawn from.
        newest_s: when that was the newest, on the monotonic clock.
    """

    content: bytes
    map_version: int
    newest_s: float


class RasterStore:
    """Draws rasters at a desk, each version once, and remembers the last of each within bounds."""

    def __init__(self, desk: QueryDesk, bytes_max: int, clock: Clock) -> None:
        self._desk = desk
        self._bytes_max = bytes_max
        self._clock = clock
        self._bytes = 0
        self._kept: OrderedDict[Hashable, Raster] = OrderedDict()
        self._under_way: dict[Hashable, tuple[int, Future[Raster]]] = {}
        self._lock = threading.Lock()

    def raster(
        self, key: Hashable, map_version: int, draw: Callable[[], bytes], max_age_s: float = 0.0
    ) -> "Raster | Future[Raster]":
        """Give a raster at once, or a future of it.

        Args:
            key: which one, whatever the version of the map.
            map_version: the newest. draw: draws from it.
            max_age_s: how long ago that of the answer may have been the newest.

        Raises:
            BusyError: too many queries wait already.
            StoppingError: the service is shutting down.
        """
        now_s = self._clock.monotonic_s()
        with self._lock:
            kept = self._kept.get(key)
            if kept is not None:
                self._kept.move_to_end(key)
                if kept.map_version == map_version:
                    return kept
                if now_s - kept.newest_s >= max_age_s:
                    kept = None
            version, future = self._under_way.get(key, (-1, None))
            if future is not None and (version == map_version or kept is not None):
                return kept or future
            try:
                future = self._desk.submit(partial(_drawn, draw, map_version, now_s))
            except BusyError:
                if kept is None:
                    raise
                return kept
            self._under_way[key] = map_version, future
        future.add_done_callback(partial(self._keep, key))
        return kept or future

    def _keep(self, key: Hashable, done: "Future[Raster]") -> None:
        with self._lock:
            if self._under_way.get(key, (0, None))[1] is done:
                del self._under_way[key]
            if done.cancelled() or done.exception() is not None:
                return
            raster, before = done.result(), self._kept.get(key)
            if before is not None and before.map_version >= raster.map_version:
                return
            if before is not None:
                self._bytes -= len(before.content)
            self._kept[key] = raster
            self._bytes += len(raster.content)
            while self._bytes > self._bytes_max:
                _, oldest = self._kept.popitem(last=False)
                self._bytes -= len(oldest.content)


def _drawn(draw: Callable[[], bytes], map_version: int, newest_s: float) -> Raster:
    return Raster(draw(), map_version, newest_s)
