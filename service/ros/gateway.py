"""What ROS 2 robots send, from the zenoh session of the service to its intake."""

import logging
import math
import queue
import threading
from collections import Counter
from collections.abc import Callable
from contextlib import suppress
from typing import Any, TypeVar

import zenoh
import zenoh.ext

from gpom_core.ros import cdr
from gpom_core.ros.keys import (
    Origin,
    TopicPattern,
    Transport,
    data_selector,
    old_cache_keys,
    presence_selectors,
    topic_of,
    topic_of_presence,
)
from service.clock import Clock, SystemClock
from service.fleet import IntakeStatus
from service.ros.intake import Intake, Kind, RosMessage
from service.ros_settings import RosSettings
from service.source import SourceSink
from service.worker import Worker

logger = logging.getLogger(__name__)

_T = TypeVar("_T")

_TICK_S = 0.05
_REPORT_S = 0.25
_CACHES = "@adv/**"  # what zenoh.ext appends to the key of a publisher that keeps samples
_STATIC_HISTORY = 100  # broadcasters of one robot, each with its last message
_ASK_S = 5.0
_AGAIN_S = 1.0  # caches are asked again after so long; each time in vain doubles it
_AGAIN_MAX_S = 60.0
_UNHEARD_MAX = 100  # topics that are warned of


class RosGateway:
    """Subscribes to scans, transforms and signs of life; one thread looks at them.

    A zenoh callback only puts the message into a bounded queue, and blocks while it is full: that
    is what slows robots down.

    Args:
        settings: of ROS.
        beams_max: a scan with more is refused.
        robots_max: scans of further robots are refused.
        clock: for waiting.
    """

    def __init__(
        self,
        settings: RosSettings,
        *,
        beams_max: int,
        robots_max: int,
        clock: Clock | None = None,
    ) -> None:
        self._settings = settings
        self._beams_max = beams_max
        self._robots_max = robots_max
        self._clock = clock or SystemClock()
        self._queue: queue.Queue[RosMessage] = queue.Queue(settings.queue_messages_max)
        self._closed = threading.Event()
        self._held: list[Any] = []
        self._caches: list[tuple[str, Callable[[zenoh.Sample], None]]] = []
        self._worker: Worker | None = None
        self._tokens: Counter[str] = Counter()
        self._unheard: set[str] = set()
        self._tokens_lock = threading.Lock()

    def attach(self, session: zenoh.Session, sink: SourceSink) -> None:
        """Start to deliver to `sink`.

        Raises:
            zenoh.ZError: the session is closed.
        """
        if not self._settings.transports:
            return
        intake = Intake(
            self._settings,
            beams_max=self._beams_max,
            robots_max=self._robots_max,
            deliver=sink.on_scan,
            clock=self._clock,
        )
        loop = _Loop(
            self._queue, self._closed, intake, sink, lambda: self._ask_again(session), self._clock
        )
        self._worker = Worker("ros", loop)
        for transport in self._settings.transports:
            self._subscribe(session, transport)
            self._watch(session, transport, sink)
        self._worker.start()

    def detach(self) -> None:
        """Stop to deliver; may be called twice."""
        self._closed.set()
        self._held = []
        worker, self._worker = self._worker, None
        if worker is not None:
            worker.join(1.0)

    def _subscribe(self, session: zenoh.Session, transport: Transport) -> None:
        settings = self._settings
        topics: list[tuple[Kind, tuple[str, ...], str]] = [
            ("tf_static", settings.tf_static_topics, cdr.TF_MESSAGE),
            ("scan", settings.scan_topics, cdr.LASER_SCAN),
        ]
        if settings.pose_from == "tf":
            topics.append(("tf", settings.tf_topics, cdr.TF_MESSAGE))
        else:
            kind = cdr.ODOMETRY if settings.pose_from == "odometry" else cdr.POSE
            topics.append(("pose", settings.pose_topics, kind))
        for kind, patterns, type_name in topics:
            for text in patterns:
                pattern = TopicPattern(text)
                key = data_selector(transport, settings.domain, pattern.key, type_name)
                callback = _caught(self._receive(kind, transport, pattern))
                if kind == "tf_static" and transport == "bridge":
                    self._ask_older_bridges(session, pattern, callback)
                if kind == "tf_static":
                    # Who comes late gets them from the publishers' caches only.
                    self._caches.append((f"{key}/{_CACHES}", callback))
                    history = zenoh.ext.HistoryConfig(
                        detect_late_publishers=True, max_samples=_STATIC_HISTORY
                    )
                    self._held.append(
                        zenoh.ext.declare_advanced_subscriber(
                            session, key, callback, history=history, subscriber_detection=True
                        )
                    )
                else:
                    self._held.append(session.declare_subscriber(key, callback))

    def _ask_older_bridges(
        self,
        session: zenoh.Session,
        pattern: TopicPattern,
        hear: Callable[[zenoh.Sample], None],
    ) -> None:
        """Ask bridges from before the autumn of 2025 for what they keep, as soon as they appear."""
        self._caches += [(key, hear) for key in old_cache_keys("*", pattern.key)]

        def on_token(sample: zenoh.Sample) -> None:
            topic = topic_of_presence("bridge", str(sample.key_expr))
            if sample.kind == zenoh.SampleKind.PUT and pattern.match(topic) is not None:
                for key in old_cache_keys("*", topic):
                    _ask(session, key, hear)

        self._watch_tokens(session, "bridge", cdr.TF_MESSAGE, on_token)

    def _ask_again(self, session: zenoh.Session) -> None:
        """Ask all caches for fixed transforms.

        A question put while routers still learn of each other may find no cache, nor does that of
        a subscriber in zenoh.ext get repeated: the robot would be lost until its node restarts.
        """
        for key, hear in self._caches:
            try:
                _ask(session, key, hear)
            except zenoh.ZError as error:
                logger.debug("caches are not asked: %s", error)
                return

    def _receive(
        self, kind: Kind, transport: Transport, pattern: TopicPattern
    ) -> Callable[[zenoh.Sample], None]:
        def receive(sample: zenoh.Sample) -> None:
            origin = pattern.match(topic_of(transport, str(sample.key_expr)))
            if sample.kind != zenoh.SampleKind.PUT or origin is None:
                return
            beside = None if sample.attachment is None else sample.attachment.to_bytes()
            message = RosMessage(kind, origin, sample.payload.to_bytes(), beside)
            while not self._closed.is_set():
                with suppress(queue.Full):
                    self._queue.put(message, timeout=_TICK_S)
                    return

        return receive

    def _watch(self, session: zenoh.Session, transport: Transport, sink: SourceSink) -> None:
        patterns = [TopicPattern(text) for text in self._settings.scan_topics]

        def on_token(sample: zenoh.Sample) -> None:
            topic = topic_of_presence(transport, str(sample.key_expr))
            origin: Origin | None = next(filter(None, (p.match(topic) for p in patterns)), None)
            if origin is None:
                self._warn_of_unheard(topic)
                return
            robot = origin.robot or self._settings.robot
            with self._tokens_lock:
                self._tokens[robot] += 1 if sample.kind == zenoh.SampleKind.PUT else -1
                alive = self._tokens[robot] > 0
            sink.on_presence(robot, alive)

        self._watch_tokens(session, transport, cdr.LASER_SCAN, on_token)

    def _warn_of_unheard(self, topic: str) -> None:
        with self._tokens_lock:
            if topic in self._unheard or len(self._unheard) >= _UNHEARD_MAX:
                return
            self._unheard.add(topic)
        logger.warning(
            "nobody takes the laser scans of /%s: the setting ros.scan_topics is %s",
            topic,
            ", ".join(self._settings.scan_topics),
        )

    def _watch_tokens(
        self,
        session: zenoh.Session,
        transport: Transport,
        type_name: str,
        hear: Callable[[zenoh.Sample], None],
    ) -> None:
        for key in presence_selectors(transport, self._settings.domain, type_name):
            self._held.append(
                session.liveliness().declare_subscriber(key, _caught(hear), history=True)
            )


class _Loop:
    """One step of the thread: a message if there is one, then what time brings."""

    def __init__(
        self,
        messages: "queue.Queue[RosMessage]",
        closed: threading.Event,
        intake: Intake,
        sink: SourceSink,
        ask: Callable[[], None],
        clock: Clock,
    ) -> None:
        self._messages = messages
        self._closed = closed
        self._intake = intake
        self._sink = sink
        self._ask = ask
        self._clock = clock
        self._unconnected = 0
        self._again_s = _AGAIN_S
        self._asked_s = -math.inf
        self._told: dict[str, IntakeStatus] = {}
        self._strangers = 0
        self._tick_s = self._report_s = 0.0

    def __call__(self) -> bool:
        try:
            message = self._messages.get(timeout=_TICK_S)
        except queue.Empty:
            pass
        else:
            self._intake.handle(message)
        now_s = self._clock.monotonic_s()
        if now_s >= self._tick_s:
            self._tick_s = now_s + _TICK_S
            self._intake.tick()
        if now_s >= self._report_s:
            self._report_s = now_s + _REPORT_S
            self._tell()
            self._mend(now_s)
        return not self._closed.is_set()

    def _tell(self) -> None:
        report = self._intake.report()
        for robot, status in report.items():
            if self._told.get(robot) != status:
                self._sink.on_intake(robot, status)
        self._told = report
        strangers, self._strangers = (
            self._intake.strangers - self._strangers,
            self._intake.strangers,
        )
        if strangers:
            self._sink.on_refused("too_many_robots", strangers)

    def _mend(self, now_s: float) -> None:
        """Ask for fixed transforms while scans lack any: ever more seldom, as it may be in vain."""
        unconnected = self._intake.unconnected()
        if unconnected == self._unconnected:
            self._again_s = max(_AGAIN_S, self._again_s / 2)
        elif now_s >= self._asked_s + self._again_s:
            self._ask()
            self._asked_s = now_s
            self._again_s = min(2 * self._again_s, _AGAIN_MAX_S)
        self._unconnected = unconnected


def _ask(session: zenoh.Session, key: str, hear: Callable[[zenoh.Sample], None]) -> None:
    def on_reply(reply: zenoh.Reply) -> None:
        if reply.ok is not None:
            hear(reply.ok)

    session.get(
        key,
        _caught(on_reply),
        target=zenoh.QueryTarget.ALL,
        consolidation=zenoh.ConsolidationMode.NONE,
        accept_replies=zenoh.ReplyKeyExpr.ANY,
        timeout=_ASK_S,
    )


def _caught(callback: Callable[[_T], None]) -> Callable[[_T], None]:
    def safe(item: _T) -> None:
        try:
            callback(item)
        except Exception:
            logger.exception("a zenoh callback failed; the sample is lost")

    return safe
