"""From bytes to stored scans: queue, decode, judge, store, tell the robots, hand on to the map."""

import logging
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

from gpom_core import wire
from gpom_core.errors import InvalidScanError
from gpom_core.scan import Scan
from service.clock import Clock
from service.errors import JournalError
from service.events import EventBus, RobotChanged
from service.fleet import Fleet
from service.journal import UNLIMITED_BEAMS, Journal, ScanRecord
from service.metrics import Metrics
from service.scan_queue import ScanQueue
from service.sequences import Admission, Cursor, SensorKey, SequenceBook, Verdict
from service.settings import IngestSettings
from service.source import Envelope
from service.worker import Worker

logger = logging.getLogger(__name__)

_RETRY_S = 1.0  # while scans cannot be stored, it is tried this often whether they can be again

Acknowledge = Callable[[Mapping[SensorKey, Cursor]], None]
"""Tells robots up to which scan everything is durable."""


def acknowledge_nothing(cursors: Mapping[SensorKey, Cursor]) -> None:
    """For sources that have no way back to robots."""


@dataclass(frozen=True, slots=True)
class Batch:
    """Stored scans on their way into the map.

    Attributes:
        records: the scans.
        ticket: the last one of the queue that is covered.
        position: in the journal, of the last record.
    """

    records: Sequence[ScanRecord]
    ticket: int
    position: int = 0


class Ingest:
    """Takes scans in. `on_scan` is called by sources, all else runs in one thread of its own."""

    def __init__(
        self,
        settings: IngestSettings,
        *,
        journal: Journal,
        hand_on: Callable[[Batch], None],
        fleet: Fleet,
        events: EventBus,
        metrics: Metrics,
        clock: Clock,
        acknowledge: Acknowledge = acknowledge_nothing,
    ) -> None:
        self.queue = ScanQueue(settings.policy, settings.queue_scans_max, settings.queue_bytes_max)
        self.worker = Worker("ingest", self._step, self._count_error)
        self._settings = settings
        self._journal = journal
        self._hand_on = hand_on
        self._acknowledge = acknowledge
        self._fleet = fleet
        self._events = events
        self._metrics = metrics
        self._clock = clock
        self._book = SequenceBook()
        self._journal_trouble: str | None = None

    def on_scan(self, robot: str, sensor: str, payload: bytes) -> None:
        """Take a scan from a source; blocks while the queue is full, if that is the policy."""
        self.queue.put(Envelope(robot, sensor, payload, self._clock.unix_s()))

    def resume(self) -> None:
        """Go on where the journal ends; to be called before the start."""
        self._book = SequenceBook(self._journal.cursors(), self._clock.monotonic_s())
        self._fleet.restore(self._journal.robots())

    def cursor(self, key: SensorKey) -> Cursor | None:
        """Give the last stored scan of a sensor; None if there is none. From any thread."""
        return self._book.cursor(key)

    def trouble(self) -> str | None:
        """Why scans cannot be taken in; None when they can."""
        return self.worker.trouble() or self._journal_trouble

    def _step(self) -> bool:
        retry_s = None if self._journal_trouble is None else _RETRY_S
        envelopes, ticket = self.queue.take(self._settings.batch_scans_max, retry_s)
        if not envelopes:
            if not self.queue.closed:
                self._try_journal()
            return not self.queue.closed
        records: list[ScanRecord] = []
        try:
            records = self._accept(envelopes)
        finally:
            # Whatever happens, the ticket travels on: a flush waits for it.
            self._hand_on(Batch(records, ticket, self._journal.position))
        return True

    def _accept(self, envelopes: Sequence[Envelope]) -> list[ScanRecord]:
        refused: Counter[tuple[str, str]] = Counter()
        admission = self._book.begin(self._clock.monotonic_s())
        records: list[ScanRecord] = []
        robots: set[str] = set()
        for envelope in envelopes:
            robot, sensor = envelope.robot, envelope.sensor
            scan = self._decode(envelope, robots, refused)
            if scan is None:
                continue
            judgement = admission.judge(SensorKey(robot, sensor), scan)
            if judgement.verdict is not Verdict.NEW:
                refused[robot, judgement.verdict.value] += 1
                continue
            robots.add(robot)
            records.append(
                ScanRecord(
                    *(robot, sensor, envelope.payload, envelope.received_unix_s, scan),
                    boot=judgement.boot,
                    lost=judgement.lost,
                )
            )
        if not self._store(records, admission):
            refused.update((record.robot, "not_stored") for record in records)
            records = []
        for record in records:
            self._note(record)
        for (robot, reason), count in refused.items():
            self._metrics.scans_refused.labels(reason).inc(count)
            self._fleet.refused_scans(robot, reason, count)
        return [record.within(self._settings.beams_max) for record in records]

    def _decode(
        self, envelope: Envelope, robots: set[str], refused: Counter[tuple[str, str]]
    ) -> Scan | None:
        if not self._fleet.has_room(envelope.robot, robots):
            refused[envelope.robot, "too_many_robots"] += 1
            return None
        try:
            # Too many beams for the map are not too many for the journal: see `ScanRecord.within`.
            return wire.decode(envelope.payload, max_beams=UNLIMITED_BEAMS)
        except InvalidScanError as error:
            refused[envelope.robot, error.reason] += 1
            logger.debug("scan of %s/%s refused: %s", envelope.robot, envelope.sensor, error)
            return None

    def _store(self, records: Sequence[ScanRecord], admission: Admission) -> bool:
        """Commit, remember, acknowledge: in this order, so nothing is promised that can be lost."""
        if records:
            try:
                with self._metrics.commit_seconds.time():
                    self._journal.append(records)
            except JournalError as error:
                self._note_trouble(error)
                return False
            self._note_trouble(None)
        admission.commit()
        if cursors := admission.cursors:
            self._acknowledge(cursors)
        return True

    def _try_journal(self) -> None:
        """See whether scans can be stored again, while none come because robots wait for that."""
        try:
            self._journal.append(())
        except JournalError as error:
            self._note_trouble(error)
        else:
            self._note_trouble(None)

    def _note_trouble(self, error: JournalError | None) -> None:
        if error is not None:
            if self._journal_trouble is None:
                logger.error("scans are refused: %s", error)
            self._metrics.journal_failures.inc()
            self._journal_trouble = f"scans cannot be stored: {error}"
        elif self._journal_trouble is not None:
            logger.info("scans are stored again")
            self._journal_trouble = None

    def _note(self, record: ScanRecord) -> None:
        if record.lost:
            self._metrics.scans_lost.inc(record.lost)
        newcomer = self._fleet.saw_scan(
            record.robot, record.scan.pose, record.lost, record.received_unix_s
        )
        if newcomer is not None:
            self._events.publish(RobotChanged(newcomer.id, newcomer.alive))

    def _count_error(self, thread: str) -> None:
        self._metrics.loop_errors.labels(thread).inc()
