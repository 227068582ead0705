"""Everything that robots say on a zenoh network, in ROS 2 or as scans of gpom."""

import queue
import threading
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from time import monotonic, time_ns
from typing import Any, Literal

import zenoh
import zenoh.ext

from gpom_core.ros import cdr
from gpom_core.ros.keys import (
    Transport,
    data_selector,
    presence_selectors,
    topic_of,
    topic_of_presence,
)

TYPES = (cdr.LASER_SCAN, cdr.TF_MESSAGE, cdr.ODOMETRY, cdr.POSE)
SCAN_TYPE = "gpom/scan"
"""In place of a ROS type, for scans of gpom's own format."""

_TRANSPORTS: tuple[Transport, ...] = ("rmw_zenoh", "bridge")

Way = Literal["rmw_zenoh", "bridge", "gpom"]

_HISTORY = 100
_MESSAGES_MAX = 20_000
_POLL_S = 0.1


def named(transports: Sequence[str] | None) -> list[Transport]:
    """Give the transports with these names; all of them for none."""
    return [way for way in _TRANSPORTS if not transports or way in transports]


@dataclass(frozen=True, slots=True)
class Heard:
    """One message.

    Attributes:
        way: how it came.
        topic: without the first slash; `<robot>/<sensor>` of a scan of gpom.
        type_name: as ROS writes it.
        payload: CDR, or the bytes of a scan.
        arrived_ns: since the epoch, by the clock of this machine.
        attachment: as rmw_zenoh writes it.
    """

    way: Way
    topic: str
    type_name: str
    payload: bytes
    arrived_ns: int
    attachment: bytes | None


@dataclass(frozen=True, slots=True)
class ListenerSettings:
    """What to listen to.

    Attributes:
        transports: of ROS.
        domain: of rmw_zenoh.
        prefix: of gpom's own scans.
    """

    transports: Sequence[Transport]
    domain: int
    prefix: str


class Listener:
    """Hears all robots from when it is made until it is closed; keeps what was not read yet.

    A bridge names no types in its keys, so its topics are found by the tokens of who publishes.

    Args:
        session: open; it stays so.
        settings: what to listen to.
    """

    def __init__(self, session: zenoh.Session, settings: ListenerSettings) -> None:
        self._session = session
        self._settings = settings
        self._queue: queue.Queue[Heard] = queue.Queue(_MESSAGES_MAX)
        self._lock = threading.Lock()
        self._held: list[Any] = []
        self._bridged: set[str] = set()
        self.dropped = 0
        self.announced: dict[tuple[Way, str], str] = {}
        for transport in settings.transports:
            for type_name in TYPES:
                if transport == "rmw_zenoh":
                    self._hear(transport, "**", type_name)
                self._watch(transport, type_name)
        self._held.append(
            session.declare_subscriber(f"{settings.prefix}/*/scan/*", self._on_native)
        )

    def messages(self, seconds: float | None, stop: threading.Event) -> Iterator[Heard]:
        """Give messages as they come, until told to stop or the time is over."""
        end_s = None if seconds is None else monotonic() + seconds
        while not stop.is_set() and (end_s is None or monotonic() < end_s):
            try:
                yield self._queue.get(timeout=_POLL_S)
            except queue.Empty:
                continue

    def close(self) -> None:
        """Hear no more."""
        with self._lock:
            held, self._held = self._held, []
        for part in held:
            part.undeclare()

    def _hear(self, transport: Transport, topic: str, type_name: str) -> None:
        key = data_selector(transport, self._settings.domain, topic, type_name)
        callback = partial(self._on_sample, transport, type_name)
        if type_name == cdr.TF_MESSAGE:
            # Fixed transforms are said once; who comes late gets them from caches.
            history = zenoh.ext.HistoryConfig(detect_late_publishers=True, max_samples=_HISTORY)
            part: Any = zenoh.ext.declare_advanced_subscriber(
                self._session, key, callback, history=history
            )
        else:
            part = self._session.declare_subscriber(key, callback)
        with self._lock:
            self._held.append(part)

    def _watch(self, transport: Transport, type_name: str) -> None:
        def on_token(sample: zenoh.Sample) -> None:
            if not _names_one(sample):
                return
            topic = topic_of_presence(transport, str(sample.key_expr))
            if sample.kind == zenoh.SampleKind.PUT:
                self.announced[transport, topic] = type_name
                if transport == "bridge" and topic not in self._bridged:
                    self._bridged.add(topic)
                    # Not from within a callback of the session.
                    threading.Thread(target=self._hear, args=(transport, topic, type_name)).start()

        for key in presence_selectors(transport, self._settings.domain, type_name):
            token = self._session.liveliness().declare_subscriber(key, on_token, history=True)
            with self._lock:
                self._held.append(token)

    def _on_sample(self, transport: Transport, type_name: str, sample: zenoh.Sample) -> None:
        if not _names_one(sample):
            return
        beside = None if sample.attachment is None else sample.attachment.to_bytes()
        self._put(transport, topic_of(transport, str(sample.key_expr)), type_name, sample, beside)

    def _on_native(self, sample: zenoh.Sample) -> None:
        if not _names_one(sample):
            return
        robot, _, sensor = str(sample.key_expr).split("/")[-3:]
        self._put("gpom", f"{robot}/{sensor}", SCAN_TYPE, sample, None)

    def _put(
        self, way: Way, topic: str, type_name: str, sample: zenoh.Sample, beside: bytes | None
    ) -> None:
        if sample.kind != zenoh.SampleKind.PUT:
            return
        heard = Heard(way, topic, type_name, sample.payload.to_bytes(), time_ns(), beside)
        try:
            self._queue.put_nowait(heard)
        except queue.Full:  # robots are never slowed down by who only listens
            self.dropped += 1


def _names_one(sample: zenoh.Sample) -> bool:
    """Whether a key says whose sample it is; one with wildcards meets many subscribers."""
    return "*" not in str(sample.key_expr)
