"""News for those who watch the map: new versions and the area they change, robots that come and go.

A watcher that reads slowly loses nothing that matters: its mailbox holds one piece of news about
the map (the newest version, all that changed since it last looked) and one about each robot.
"""

import asyncio
import threading
from collections.abc import AsyncIterator, Callable
from dataclasses import dataclass
from types import TracebackType
from typing import Self

from service.errors import BusyError, StoppingError

Bounds = tuple[float, float, float, float]


@dataclass(frozen=True, slots=True)
class MapChanged:
    """Experts were swapped in; `changed` is xmin, ymin, xmax, ymax in m, None for nothing yet."""

    map_version: int
    changed: Bounds | None


@dataclass(frozen=True, slots=True)
class RobotChanged:
    """A robot was seen for the first time, came back, or went."""

    robot: str
    alive: bool


Event = MapChanged | RobotChanged


def union(first: Bounds | None, second: Bounds | None) -> Bounds | None:
    """Give the smallest box around two, either of which may be None for the empty box."""
    if first is None or second is None:
        return first or second
    return (
        min(first[0], second[0]),
        min(first[1], second[1]),
        max(first[2], second[2]),
        max(first[3], second[3]),
    )


class Subscription:
    """The mailbox of one watcher. Filled from any thread, read in the event loop it was made in."""

    def __init__(self, bus: "EventBus") -> None:
        self._bus = bus
        self._loop = asyncio.get_running_loop()
        self._news = asyncio.Event()
        self._lock = threading.Lock()
        self._map: MapChanged | None = None
        self._robots: dict[str, RobotChanged] = {}
        self._closed = False

    def put(self, event: Event) -> None:
        """Add news, merged with what was not read yet."""
        with self._lock:
            if isinstance(event, MapChanged):
                before = None if self._map is None else self._map.changed
                self._map = MapChanged(event.map_version, union(before, event.changed))
            else:
                self._robots[event.robot] = event
        self._wake()

    def end(self) -> None:
        """Let the reader stop."""
        self._closed = True
        self._wake()

    async def batches(self, keepalive_s: float) -> AsyncIterator[list[Event]]:
        """Give news as it comes, and an empty list when none came for `keepalive_s`."""
        while not self._closed:
            try:
                await asyncio.wait_for(self._news.wait(), keepalive_s)
            except TimeoutError:
                yield []
                continue
            self._news.clear()
            if events := self._take():
                yield events

    def _take(self) -> list[Event]:
        with self._lock:
            events: list[Event] = list(self._robots.values())
            if self._map is not None:
                events.append(self._map)
            self._robots, self._map = {}, None
        return events

    def _wake(self) -> None:
        if not self._loop.is_closed():
            self._loop.call_soon_threadsafe(self._news.set)

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self._bus.unsubscribe(self)


class EventBus:
    """Hands news to every watcher; safe to use from any thread."""

    def __init__(self, clients_max: int) -> None:
        self._clients_max = clients_max
        self._subscriptions: set[Subscription] = set()
        self._listeners: list[Callable[[Event], None]] = []
        self._lock = threading.Lock()
        self._closed = False

    @property
    def clients(self) -> int:
        """Watchers at the moment."""
        return len(self._subscriptions)

    def publish(self, event: Event) -> None:
        """Hand out news; returns at once."""
        with self._lock:
            watchers, listeners = tuple(self._subscriptions), tuple(self._listeners)
        for subscription in watchers:
            subscription.put(event)
        for hear in listeners:
            hear(event)

    def listen(self, hear: Callable[[Event], None]) -> None:
        """Call a function with all news from now on; it must return at once and not raise."""
        with self._lock:
            self._listeners.append(hear)

    def subscribe(self) -> Subscription:
        """Open a mailbox for the running event loop; leave it as a context manager.

        Raises:
            BusyError: as many watchers as there may be.
            StoppingError: the bus is closed.
        """
        subscription = Subscription(self)
        with self._lock:
            if self._closed:
                raise StoppingError("the service is shutting down; no more events will come")
            if len(self._subscriptions) >= self._clients_max:
                message = f"{self._clients_max} event streams are open, the most there may be"
                raise BusyError(message)
            self._subscriptions.add(subscription)
        return subscription

    def unsubscribe(self, subscription: Subscription) -> None:
        """Forget a mailbox."""
        with self._lock:
            self._subscriptions.discard(subscription)

    def close(self) -> None:
        """End every stream, and refuse new ones."""
        with self._lock:
            self._closed = True
            watchers = tuple(self._subscriptions)
        for subscription in watchers:
            subscription.end()
