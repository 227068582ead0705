"""The port by which accepted scans are stored, before they are acknowledged and integrated.

The order is the promise: `append` returns, then robots are told, then the map changes.
Stored scans are numbered 1, 2, 3, … by their position; a checkpoint of the map knows up to which
position it goes.
"""

from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Protocol

from gpom_core.scan import Scan
from service.errors import JournalError
from service.fleet import RobotStatus
from service.sequences import Cursor, SensorKey

UNLIMITED_BEAMS = 2**32 - 1
"""For scans that are read back: they were valid when stored, and limits may be lower by now."""


@dataclass(frozen=True, slots=True)
class ScanRecord:
    """A scan that was decoded and found to be new, with the bytes it came in.

    Attributes:
        robot, sensor: that sent it.
        payload: the bytes.
        received_unix_s: when they came.
        scan: what they say.
        boot: of the run that it counts under; see `service.sequences`.
        lost: scans that are missing just before it.
        withheld: why it is stored but does not enter the map; None of nearly all.
    """

    robot: str
    sensor: str
    payload: bytes
    received_unix_s: float
    scan: Scan
    boot: int = 0
    lost: int = 0
    withheld: str | None = None

    def within(self, beams_max: int) -> "ScanRecord":
        """The same, ready for the map; of one with too many beams only the fact is left.

        Such a scan is durable like any other: refused, it would hold up its stream for ever. It is
        in the journal for the day that the limit is raised.
        """
        if len(self.scan.ranges_m) <= beams_max:
            return self
        scan = replace(self.scan, ranges_m=self.scan.ranges_m[:1].copy(), intensities=None)
        return replace(self, payload=b"", scan=scan, withheld="too_many_beams")


@dataclass(frozen=True, slots=True)
class StoredScan:
    """A scan as it is read back: not decoded again yet."""

    position: int
    robot: str
    sensor: str
    payload: bytes
    received_unix_s: float


class Journal(Protocol):
    """Where accepted scans are kept. One thread appends; `replay` may run beside it."""

    @property
    def durable(self) -> bool:
        """Whether scans outlive the process."""
        ...

    @property
    def position(self) -> int:
        """Of the last scan that was stored; 0 before the first."""
        ...

    def open(self) -> None:
        """Get ready; to be called before everything else.

        Raises:
            JournalError: it cannot be used; says why and what to do.
        """

    def append(self, records: Sequence[ScanRecord]) -> None:
        """Store all of them or none; on return they are as durable as this journal makes them.

        With no records it is tried whether something could be stored.

        Raises:
            JournalError: nothing was stored.
        """

    def cursors(self) -> Mapping[SensorKey, Cursor]:
        """Give the last scan of every sensor that was ever stored."""
        ...

    def robots(self) -> Sequence[RobotStatus]:
        """Give what is known of every robot whose scans were ever stored."""
        ...

    def replay(self, after: int, until: int) -> Iterator[StoredScan]:
        """Read scans with `after` < position <= `until`, in order.

        Raises:
            JournalError: some of them are not there any more, or are damaged.
        """
        ...

    def release(self, position: int) -> None:
        """Scans up to `position` are in checkpoints, so they may be deleted when space is short."""

    def close(self) -> None:
        """Release what is held. May be called twice."""


class NoJournal:
    """Keeps nothing: the map lives as long as the process."""

    durable = False
    position = 0

    def open(self) -> None:
        """Do nothing."""

    def append(self, records: Sequence[ScanRecord]) -> None:
        """Let them pass."""

    def cursors(self) -> Mapping[SensorKey, Cursor]:
        """None."""
        return {}

    def robots(self) -> Sequence[RobotStatus]:
        """None."""
        return ()

    def replay(self, after: int, until: int) -> Iterator[StoredScan]:  # noqa: ARG002 - the port's
        """None."""
        return iter(())

    def release(self, position: int) -> None:
        """Do nothing."""

    def close(self) -> None:
        """Do nothing."""


@dataclass(slots=True)
class MemoryJournal:
    """Keeps records in a list, and fails when told to."""

    records: list[ScanRecord] = field(default_factory=list)
    broken: str | None = None
    durable: bool = False

    @property
    def position(self) -> int:
        """Of the last record."""
        return len(self.records)

    def open(self) -> None:
        """Do nothing."""

    def append(self, records: Sequence[ScanRecord]) -> None:
        """Store all of them or none.

        Raises:
            JournalError: `broken` is set.
        """
        if self.broken is not None:
            raise JournalError(self.broken)
        self.records.extend(records)

    def cursors(self) -> Mapping[SensorKey, Cursor]:
        """Give the last scan of every sensor."""
        found: dict[SensorKey, Cursor] = {}
        for record in self.records:
            if record.scan.seq:
                key = SensorKey(record.robot, record.sensor)
                found[key] = Cursor(record.boot, record.scan.seq)
        return found

    def robots(self) -> Sequence[RobotStatus]:
        """Give what is known of every robot."""
        scans, lost = Counter[str](), Counter[str]()
        last = {}
        for record in self.records:
            scans[record.robot] += 1
            lost[record.robot] += record.lost
            last[record.robot] = record
        return [
            RobotStatus(robot, scans[robot], lost[robot], record.received_unix_s, record.scan.pose)
            for robot, record in last.items()
        ]

    def replay(self, after: int, until: int) -> Iterator[StoredScan]:
        """Read records in order."""
        for index, record in enumerate(self.records[after:until], start=after + 1):
            yield StoredScan(
                index, record.robot, record.sensor, record.payload, record.received_unix_s
            )

    def release(self, position: int) -> None:
        """Keep them all the same."""

    def close(self) -> None:
        """Do nothing: the records stay readable."""
