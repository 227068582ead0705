"""How many scans were stored, in a file beside the journal: what SQLite cannot tell.

When its write-ahead log is cut, removed or damaged, SQLite takes what is left for all there was.
The mark is written after each commit and never waited for: a killed process leaves the right one,
a power cut at worst an older one, so it is never ahead of an undamaged journal.
"""

import logging
import os
import re
from pathlib import Path

logger = logging.getLogger(__name__)

_CONTENT = re.compile(rb"(?P<journal>\w+) (?P<position>\d{20})\n")


class JournalMark:
    """The file; there is none before something is stored."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self._file: int | None = None

    def read(self, journal: str) -> int:
        """Give the last position that was written for a journal; 0 if there is none."""
        try:
            content = _CONTENT.fullmatch(self.path.read_bytes())
        except FileNotFoundError:
            return 0
        if content is None or content["journal"].decode() != journal:
            logger.warning("%s does not belong to the journal beside it", self.path)
            return 0
        return int(content["position"])

    def write(self, journal: str, position: int) -> None:
        """Note that a journal goes up to a position. Never fails: what it tells is stored."""
        try:
            if self._file is None:
                self._file = os.open(self.path, os.O_RDWR | os.O_CREAT, 0o644)
            os.pwrite(self._file, f"{journal} {position:020d}\n".encode(), 0)
        except OSError as error:
            logger.debug("%s is not written: %s", self.path, error)

    def close(self) -> None:
        """Release it. May be called twice."""
        file, self._file = self._file, None
        if file is not None:
            os.close(file)
