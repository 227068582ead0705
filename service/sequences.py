"""Which scans of a stream are new, which were seen before, and how many never came.

A stream is one run (`boot`) of one sensor of one robot; its scans are numbered from 1. Reliable
streams have no gaps: what comes too early is refused, and the robot sends again from the cursor.

Runs are ordered by their boot, so one that began by a clock set back looks like an old one. A
reliable publisher learns that from the cursor and takes a later boot. A best-effort robot asks
nothing, so its sensor is heard again once the run before has been silent for `SILENCE_S`, and
counts from then on as a run after that one.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from enum import Enum
from typing import NamedTuple

from gpom_core.scan import Scan

SILENCE_S = 5.0  # a run that sent nothing for so long may be followed by one of an earlier boot


class SensorKey(NamedTuple):
    """One sensor of one robot."""

    robot: str
    sensor: str


class Cursor(NamedTuple):
    """The last scan that was accepted from a sensor. Ordered as robots produce scans."""

    boot: int
    seq: int


class Verdict(Enum):
    """What becomes of a scan."""

    NEW = "new"
    STALE = "stale"  # seen before, or overtaken by a later one of the same sensor
    EARLY = "out_of_order"  # reliable, and some before it have not come yet
    OLD_RUN = "old_run"  # of a run that a later one has replaced


@dataclass(frozen=True, slots=True)
class Judgement:
    """What becomes of a scan.

    Attributes:
        verdict: see there.
        lost: scans of the stream that are missing just before this one.
        boot: of the run that it counts under: the robot's own, but for clocks that were set back.
    """

    verdict: Verdict
    lost: int = 0
    boot: int = 0


class SequenceBook:
    """The cursor of every sensor. One thread changes it; any may ask for a cursor.

    A scan numbered 0 belongs to no stream and is always new. The first scan ever of a best-effort
    sensor may have any number, since the robot may have been running before the service was.

    Args:
        cursors: of scans that were accepted before.
        now_s: by a clock that never goes back; all sensors count as heard then.
    """

    def __init__(
        self, cursors: Mapping[SensorKey, Cursor] | None = None, now_s: float = 0.0
    ) -> None:
        self._entries = {
            key: _Entry(cursor, cursor.boot, now_s) for key, cursor in (cursors or {}).items()
        }

    def begin(self, now_s: float = 0.0) -> "Admission":
        """Judge a batch of scans; nothing is remembered until it is committed."""
        return Admission(self._entries, now_s)

    def cursor(self, key: SensorKey) -> Cursor | None:
        """Give the last committed scan of a sensor; None if there is none."""
        entry = self._entries.get(key)
        return None if entry is None else entry.cursor


class _Entry(NamedTuple):
    """Where a sensor is, the boot that its robot gives for that run, and when it was heard."""

    cursor: Cursor
    stated_boot: int
    heard_s: float


class Admission:
    """A batch that is being judged. If it cannot be stored, drop it: the book is unchanged."""

    def __init__(self, entries: dict[SensorKey, _Entry], now_s: float) -> None:
        self._book = entries
        self._now_s = now_s
        self._pending: dict[SensorKey, _Entry] = {}
        self._repeated: set[SensorKey] = set()

    @property
    def cursors(self) -> Mapping[SensorKey, Cursor]:
        """What to acknowledge once the batch is durable: streams that moved, or were repeated.

        A robot that repeats a scan has missed an acknowledgement.
        """
        known = {key: self._book[key] for key in self._repeated if key in self._book}
        return {key: entry.cursor for key, entry in (known | self._pending).items()}

    def judge(self, key: SensorKey, scan: Scan) -> Judgement:
        """Tell whether a scan is new, seen from all before it in the book and in this batch."""
        if scan.seq == 0:
            return Judgement(Verdict.NEW, boot=scan.boot)
        last = self._pending.get(key) or self._book.get(key)
        if scan.reliable:
            judgement = _judge_reliable(scan, None if last is None else last.cursor)
        elif last is None:
            judgement = Judgement(Verdict.NEW, boot=scan.boot)
        else:
            judgement = self._judge_best_effort(scan, last)
        if judgement.verdict is Verdict.NEW:
            cursor = Cursor(judgement.boot, scan.seq)
            self._pending[key] = _Entry(cursor, scan.boot, self._now_s)
        elif scan.reliable:
            self._repeated.add(key)
        return judgement

    def _judge_best_effort(self, scan: Scan, last: _Entry) -> Judgement:
        cursor = last.cursor
        if scan.boot == last.stated_boot:
            if scan.seq <= cursor.seq:
                return Judgement(Verdict.STALE)
            return Judgement(Verdict.NEW, scan.seq - cursor.seq - 1, cursor.boot)
        if scan.boot > cursor.boot:
            return Judgement(Verdict.NEW, scan.seq - 1, scan.boot)
        if self._now_s - last.heard_s < SILENCE_S:
            return Judgement(Verdict.OLD_RUN)
        # Those of this run that came before were refused, and counted as that: none is missing.
        return Judgement(Verdict.NEW, boot=cursor.boot + 1)

    def commit(self) -> None:
        """Remember the batch."""
        self._book.update(self._pending)


def _judge_reliable(scan: Scan, last: Cursor | None) -> Judgement:
    if last is not None and scan.boot < last.boot:
        return Judgement(Verdict.OLD_RUN)
    durable = last.seq if last is not None and scan.boot == last.boot else 0
    if scan.seq <= durable:
        return Judgement(Verdict.STALE)
    return Judgement(Verdict.NEW if scan.seq == durable + 1 else Verdict.EARLY, boot=scan.boot)
