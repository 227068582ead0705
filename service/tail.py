"""Scans that the journal holds beyond a checkpoint, on their way back into the map."""

import logging
from collections.abc import Iterator
from itertools import islice

from gpom_core import wire
from gpom_core.errors import InvalidScanError
from service.errors import JournalError
from service.journal import UNLIMITED_BEAMS, ScanRecord, StoredScan

logger = logging.getLogger(__name__)


class Tail:
    """Reads them in order, once.

    Args:
        stored: the scans.
        position: in the journal, after which they begin.
        beams_max: of a scan that may enter the map.
    """

    def __init__(self, stored: Iterator[StoredScan], position: int, beams_max: int) -> None:
        self._stored = stored
        self._begin = position
        self._beams_max = beams_max
        self._trouble: str | None = None
        self.position = position

    @property
    def trouble(self) -> str | None:
        """Why no more can be read, though there is more; None while all is well."""
        return self._trouble

    @property
    def held_any(self) -> bool:
        """Whether there was anything beyond the checkpoint."""
        return self.position > self._begin

    def take(self, limit: int) -> list[ScanRecord]:
        """Read at most `limit` scans; none at the end, or when there is trouble."""
        records: list[ScanRecord] = []
        try:
            for stored in islice(self._stored, limit):
                scan = wire.decode(stored.payload, max_beams=UNLIMITED_BEAMS)
                record = ScanRecord(
                    stored.robot, stored.sensor, stored.payload, stored.received_unix_s, scan
                )
                records.append(record.within(self._beams_max))
                self.position = stored.position
        except (InvalidScanError, JournalError) as error:
            # Without these scans the map is not what it was, so nobody may be told that it is.
            logger.exception("the map cannot be restored")
            self._trouble = f"the map cannot be restored: {error}"
        return records
