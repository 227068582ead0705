"""The end of the process, asked for by a signal at any time from its first lines on."""

import logging
import signal
from collections.abc import Callable
from types import FrameType

logger = logging.getLogger(__name__)

_SIGNALS = (signal.SIGINT, signal.SIGTERM)


class Ending:
    """Hears SIGINT and SIGTERM; only the main thread may make one.

    What runs when one comes is not torn apart: it looks at `wanted` when it is safe to stop, or is
    told once it has said whom to tell.
    """

    def __init__(self) -> None:
        self.wanted = False
        self._tell: Callable[[], None] | None = None
        for number in _SIGNALS:
            signal.signal(number, self._hear)

    def tell(self, end: Callable[[], None]) -> None:
        """Call `end` when a signal comes; now, if one has come."""
        self._tell = end
        if self.wanted:
            end()

    def _hear(self, number: int, _: FrameType | None) -> None:
        logger.info("received %s", signal.Signals(number).name)
        self.wanted = True
        if self._tell is not None:
            self._tell()
