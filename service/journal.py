"""The port by which accepted scans are stored, before they are acknowledged and integrated.

The order is the promise: `append` returns, then robots are told, then the map changes.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Protocol

from gpom_core.scan import Scan
from service.errors import JournalError


@dataclass(frozen=True, slots=True)
class ScanRecord:
    """A scan that was decoded and found to be new, with the bytes it came in."""

    robot: str
    sensor: str
    payload: bytes
    received_unix_s: float
    scan: Scan


class Journal(Protocol):
    """Where accepted scans are kept."""

    def append(self, records: Sequence[ScanRecord]) -> None:
        """Store all of them or none; on return they are as durable as this journal makes them.

        Raises:
            JournalError: nothing was stored.
        """

    def close(self) -> None:
        """Release what is held. May be called twice."""


class NoJournal:
    """Keeps nothing: the map lives as long as the process."""

    def append(self, records: Sequence[ScanRecord]) -> None:
        """Let them pass."""

    def close(self) -> None:
        """Do nothing."""


@dataclass(slots=True)
class MemoryJournal:
    """Keeps records in a list, and fails when told to."""

    records: list[ScanRecord] = field(default_factory=list)
    broken: str | None = None

    def append(self, records: Sequence[ScanRecord]) -> None:
        """Store all of them or none.

        Raises:
            JournalError: `broken` is set.
        """
        if self.broken is not None:
            raise JournalError(self.broken)
        self.records.extend(records)

    def close(self) -> None:
        """Do nothing: the records stay readable."""
