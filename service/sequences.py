"""Which scans of a stream are new, which were seen before, and how many never came.

A stream is one run (`boot`) of one sensor of one robot; its scans are numbered from 1. Reliable
streams have no gaps: what comes too early is refused, and the robot sends again from the cursor.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from enum import Enum
from typing import NamedTuple

from gpom_core.scan import Scan


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
    OLD_RUN = "old_run"  # reliable, of a run that a later one has replaced


@dataclass(frozen=True, slots=True)
class Judgement:
    """A verdict, and how many scans of the stream are missing just before this one."""

    verdict: Verdict
    lost: int = 0


class SequenceBook:
    """The cursor of every sensor. One thread changes it; any may ask for a cursor.

    A scan numbered 0 belongs to no stream and is always new. The first scan ever of a best-effort
    sensor may have any number, since the robot may have been running before the service was.
    """

    def __init__(self, cursors: Mapping[SensorKey, Cursor] | None = None) -> None:
        self._cursors: dict[SensorKey, Cursor] = dict(cursors or {})

    def begin(self) -> "Admission":
        """Judge a batch of scans; nothing is remembered until it is committed."""
        return Admission(self._cursors)

    def cursor(self, key: SensorKey) -> Cursor | None:
        """Give the last committed scan of a sensor; None if there is none."""
        return self._cursors.get(key)


class Admission:
    """A batch that is being judged. If it cannot be stored, drop it: the book is unchanged."""

    def __init__(self, cursors: dict[SensorKey, Cursor]) -> None:
        self._book = cursors
        self._pending: dict[SensorKey, Cursor] = {}
        self._repeated: set[SensorKey] = set()

    @property
    def cursors(self) -> Mapping[SensorKey, Cursor]:
        """What to acknowledge once the batch is durable: streams that moved, or were repeated.

        A robot that repeats a scan has missed an acknowledgement.
        """
        known = {key: self._book[key] for key in self._repeated if key in self._book}
        return known | self._pending

    def judge(self, key: SensorKey, scan: Scan) -> Judgement:
        """Tell whether a scan is new, seen from all before it in the book and in this batch."""
        if scan.seq == 0:
            return Judgement(Verdict.NEW)
        here = Cursor(scan.boot, scan.seq)
        last = self._pending.get(key) or self._book.get(key)
        if scan.reliable:
            verdict = _judge_reliable(here, last)
            if verdict is not Verdict.NEW:
                self._repeated.add(key)
                return Judgement(verdict)
        elif last is not None and here <= last:
            return Judgement(Verdict.STALE)
        self._pending[key] = here
        if last is None:
            return Judgement(Verdict.NEW)
        expected = last.seq + 1 if here.boot == last.boot else 1
        return Judgement(Verdict.NEW, lost=here.seq - expected)

    def commit(self) -> None:
        """Remember the batch."""
        self._book.update(self._pending)


def _judge_reliable(here: Cursor, last: Cursor | None) -> Verdict:
    if last is not None and here.boot < last.boot:
        return Verdict.OLD_RUN
    durable = last.seq if last is not None and here.boot == last.boot else 0
    if here.seq <= durable:
        return Verdict.STALE
    return Verdict.NEW if here.seq == durable + 1 else Verdict.EARLY
