"""The map as ROS 2 wants it: an occupancy grid that is there for who comes late, and its changes.

The whole grid is latched (transient local, by the cache of an advanced publisher). Changes go out
as updates of the last grid, a grid that grew goes out as a whole, and after changes the whole grid
is sent again now and then, so that the latched one is not old.
"""

import logging
import threading
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import zenoh
import zenoh.ext

from gpom_core.errors import GpomError
from gpom_core.member import Bounds
from gpom_core.ros import attachment, cdr
from gpom_core.ros.keys import NO_HASH, data_key, node_token, old_cache_keys, publisher_token
from gpom_core.ros.messages import write_grid, write_grid_update
from gpom_core.snapshot import Snapshot
from service.clock import Clock, SystemClock
from service.events import Event, EventBus, MapChanged, union
from service.ros.raster import UNKNOWN, Cells, Patch, cells_of, patch_over
from service.ros_settings import RosSettings
from service.source import SourceSink
from service.worker import Worker

logger = logging.getLogger(__name__)

NODE = "gpom"
_CDR = "application/cdr"
_HEARTBEAT_S = 0.5
_NANOSECONDS = 1e9


class _Topic:
    """One topic, under every key by which somebody may listen to it."""

    def __init__(
        self, session: zenoh.Session, settings: RosSettings, topic: str, type_name: str, number: int
    ) -> None:
        self._sequence = 0
        self._gid = bytes.fromhex(str(session.zid()).rjust(32, "0"))[:15] + bytes([number % 256])
        latched = type_name == cdr.OCCUPANCY_GRID
        self._publishers = [
            _publisher(session, key, latched=latched) for key in _keys(settings, topic, type_name)
        ]
        self._topic = topic
        self._last: bytes | None = None
        self._caches = []
        if latched and "bridge" in settings.transports:
            self._caches = [
                session.declare_queryable(key, self._answer_older_bridge)
                for key in old_cache_keys(str(session.zid()), topic)
            ]
        self._tokens = []
        if "rmw_zenoh" in settings.transports:
            token = publisher_token(
                settings.domain,
                str(session.zid()),
                NODE,
                number=number,
                topic=topic,
                type_name=type_name,
                latched=latched,
            )
            self._tokens.append(session.liveliness().declare_token(token))

    def send(self, payload: bytes, at_ns: int) -> None:
        """Publish a message."""
        self._last = payload if self._caches else None
        self._sequence += 1
        beside = attachment.write(attachment.Attachment(self._sequence, at_ns, self._gid))
        for publisher in self._publishers:
            publisher.put(payload, encoding=_CDR, attachment=beside)

    def _answer_older_bridge(self, query: zenoh.Query) -> None:
        """Give the last message to a bridge that knows no advanced publisher."""
        with query:
            if self._last is not None:
                query.reply(self._topic, self._last, encoding=_CDR)


@dataclass(slots=True)
class _Grid:
    """What subscribers hold.

    Attributes:
        patch: its cells.
        cells: (rows, columns).
    """

    patch: Patch
    cells: Cells


@dataclass(slots=True)
class _News:
    """What changed since the last look; guarded by the condition."""

    changed: threading.Condition = field(default_factory=threading.Condition)
    area: Bounds | None = None
    fresh: bool = False
    closed: bool = False


class MapPublisher:
    """Publishes the map in a thread of its own.

    Args:
        settings: of ROS.
        clock: for stamps and intervals.
    """

    def __init__(self, settings: RosSettings, clock: Clock | None = None) -> None:
        self._settings = settings
        self._clock = clock or SystemClock()
        self._news = _News()
        self._snapshot: Callable[[], Snapshot] | None = None
        self._worker: Worker | None = None
        self._grid: _Grid | None = None
        self._grids: list[_Topic] = []
        self._updates: list[_Topic] = []
        self._node: Any = None
        self._full_s = 0.0
        self._stale = False
        self._too_large = False

    def follow(self, snapshot: Callable[[], Snapshot], events: EventBus) -> None:
        """Publish this map whenever it changes."""
        self._snapshot = snapshot
        events.listen(self._hear)

    def attach(self, session: zenoh.Session, sink: SourceSink) -> None:  # noqa: ARG002 - of guests
        """Start to publish.

        Raises:
            zenoh.ZError: the session is closed.
        """
        settings = self._settings
        if not (settings.transports and settings.map.publish) or self._snapshot is None:
            return
        if "rmw_zenoh" in settings.transports:
            token = node_token(settings.domain, str(session.zid()), NODE)
            self._node = session.liveliness().declare_token(token)
        for number, topic in enumerate(settings.map.topics):
            self._grids.append(_Topic(session, settings, topic, cdr.OCCUPANCY_GRID, 2 * number + 1))
            updates = f"{topic}_updates"
            self._updates.append(
                _Topic(session, settings, updates, cdr.GRID_UPDATE, 2 * number + 2)
            )
        self._news.fresh = True  # a map that was restored before anyone listened
        self._worker = Worker("ros-map", self._step)
        self._worker.start()

    def detach(self) -> None:
        """Stop to publish; may be called twice."""
        with self._news.changed:
            self._news.closed = True
            self._news.changed.notify_all()
        worker, self._worker = self._worker, None
        if worker is not None:
            worker.join(2.0)
        self._grids, self._updates, self._node = [], [], None

    def _hear(self, event: Event) -> None:
        if isinstance(event, MapChanged):
            with self._news.changed:
                self._news.area = union(self._news.area, event.changed)
                self._news.fresh = True
                self._news.changed.notify_all()

    def _step(self) -> bool:
        news, settings = self._news, self._settings.map
        with news.changed:
            wait_s = None
            if self._stale:
                wait_s = max(self._full_s + settings.full_interval_s - self._clock.monotonic_s(), 0)
            news.changed.wait_for(lambda: news.closed or news.fresh, wait_s)
            if news.closed:
                return False
            area, news.area, fresh, news.fresh = news.area, None, news.fresh, False
        if fresh:
            self._publish(area)
        if self._stale and self._clock.monotonic_s() >= self._full_s + settings.full_interval_s:
            self._send_full()
        with news.changed:  # not more often than that
            news.changed.wait_for(lambda: news.closed, settings.interval_s)
            return not news.closed

    def _publish(self, area: Bounds | None) -> None:
        if self._snapshot is None:
            return
        try:
            snapshot = self._snapshot()
        except GpomError as error:  # it is being restored
            logger.debug("no map to publish: %s", error)
            return
        if snapshot.main_reach is None or (self._grid is not None and area is None):
            return
        resolution_m = self._settings.map.resolution_m
        everything = patch_over(snapshot.main_reach, resolution_m)
        whole, grid = everything.grown(), self._grid
        if grid is not None and whole.joined(grid.patch).cells <= self._settings.map.cells_max:
            whole = whole.joined(grid.patch)
        else:  # it began, or its beginning turned out to be a speck far from the map
            grid = None
        if not self._fits(whole):
            return
        touched = everything if grid is None or area is None else patch_over(area, resolution_m)
        changed = touched.clipped(whole)
        if changed is None:  # a speck far away
            return
        grew = grid is None or whole != grid.patch
        grid = self._grid = _resized(grid, whole)
        fresh = cells_of(snapshot.grid(changed.bounds(resolution_m), resolution_m))
        grid.cells[changed.within(whole)] = fresh
        if grew:
            self._send_full()
        else:
            self._stale = True
            self._send_update(grid, changed, fresh)

    def _fits(self, whole: Patch) -> bool:
        fits = whole.cells <= self._settings.map.cells_max
        if not fits and not self._too_large:
            logger.warning(
                "the map has %d x %d cells of %g m and is not published any more; the setting "
                "ros.map.cells_max allows %d: choose a coarser ros.map.resolution_m",
                whole.columns,
                whole.rows,
                self._settings.map.resolution_m,
                self._settings.map.cells_max,
            )
        self._too_large = not fits
        return fits

    def _send_full(self) -> None:
        grid = self._grid
        if grid is None:
            return
        at_ns = round(self._clock.unix_s() * _NANOSECONDS)
        resolution_m = self._settings.map.resolution_m
        origin = grid.patch.bounds(resolution_m)[:2]
        frame = self._settings.map_frame
        payload = write_grid(grid.cells, origin, resolution_m, frame, at_ns)
        for topic in self._grids:
            topic.send(payload, at_ns)
        self._full_s = self._clock.monotonic_s()
        self._stale = False

    def _send_update(self, grid: _Grid, changed: Patch, cells: Cells) -> None:
        rows, columns = changed.within(grid.patch)
        at_ns = round(self._clock.unix_s() * _NANOSECONDS)
        frame = self._settings.map_frame
        payload = write_grid_update(cells, columns.start, rows.start, frame, at_ns)
        for topic in self._updates:
            topic.send(payload, at_ns)


def _resized(grid: _Grid | None, whole: Patch) -> _Grid:
    if grid is not None and grid.patch == whole:
        return grid
    cells = np.full((whole.rows, whole.columns), UNKNOWN, np.int8)
    if grid is not None:
        cells[grid.patch.within(whole)] = grid.cells
    return _Grid(whole, cells)


def _keys(settings: RosSettings, topic: str, type_name: str) -> list[str]:
    keys = []
    if "rmw_zenoh" in settings.transports:
        # Humble listens under a key of its own.
        keys += [
            data_key(settings.domain, topic, type_name),
            data_key(settings.domain, topic, type_name, NO_HASH),
        ]
    if "bridge" in settings.transports:
        keys.append(topic)
    return keys


def _publisher(session: zenoh.Session, key: str, *, latched: bool) -> Any:
    if not latched:
        return session.declare_publisher(key)
    return zenoh.ext.declare_advanced_publisher(
        session,
        key,
        cache=zenoh.ext.CacheConfig(max_samples=1),
        publisher_detection=True,
        sample_miss_detection=zenoh.ext.MissDetectionConfig(
            heartbeat=None, sporadic_heartbeat=_HEARTBEAT_S
        ),
    )
