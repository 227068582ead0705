"""Up to which scan the map has stored a stream: it says so unasked, and when it is asked.

Who may put on a key with wildcards, such as `gpom/v1/site/*/ack/laser`, reaches all robots at once.
Whatever that is, it is not about this stream: only what is said on its own key is.
"""

import logging
import struct
from collections.abc import Callable
from enum import Enum
from typing import NamedTuple

import zenoh

from clients.errors import DeliveryError
from clients.keys import StreamKeys

ASK_TIMEOUT_S = 2.0
_CURSOR = struct.Struct("<QQ")

_logger = logging.getLogger(__name__)


class Cursor(NamedTuple):
    """The last scan of a stream that the map has stored."""

    boot: int
    seq: int


class Unknown(Enum):
    """What a map may say instead of a cursor."""

    STREAM = "the map does not know the stream"
    MAP = "no map answered"


class Cursors:
    """Hears acknowledgements of one stream, and asks for its cursor.

    Args:
        session: open; it is not closed here.
        keys: of the stream.
        on_ack: told every acknowledgement, by a thread of zenoh's.
    """

    def __init__(
        self, session: zenoh.Session, keys: StreamKeys, on_ack: Callable[[Cursor], None]
    ) -> None:
        self._session = session
        self._keys = keys
        self._tell = on_ack
        self._warned = False
        self._subscriber = session.declare_subscriber(keys.ack, self._on_ack)

    def ask(self) -> Cursor | Unknown:
        """Ask the map where the stream is.

        Raises:
            DeliveryError: the session is closed.
        """
        try:
            replies = self._session.get(
                self._keys.cursor,
                consolidation=zenoh.ConsolidationMode.NONE,
                timeout=ASK_TIMEOUT_S,
            )
            for reply in replies:
                if reply.ok is not None and str(reply.ok.key_expr) == self._keys.cursor:
                    return _read(reply.ok) or Unknown.STREAM
        except zenoh.ZError as error:
            raise DeliveryError(f"cannot ask for {self._keys.cursor}: {error}") from error
        return Unknown.MAP

    def close(self) -> None:
        """Hear no more."""
        self._subscriber.undeclare()  # type: ignore[no-untyped-call] # the stub gives no result type

    def _on_ack(self, sample: zenoh.Sample) -> None:
        key = str(sample.key_expr)
        if key != self._keys.ack:
            if not self._warned:
                self._warned = True
                _logger.warning(
                    "an acknowledgement on %s is not for %s alone, and ignored, as all such are "
                    "from now on; whoever puts there is mistaken, or no friend",
                    key,
                    self._keys.scan,
                )
        elif (cursor := _read(sample)) is not None:
            self._tell(cursor)


def _read(sample: zenoh.Sample) -> Cursor | None:
    payload = sample.payload.to_bytes()
    return Cursor(*_CURSOR.unpack(payload)) if len(payload) == _CURSOR.size else None
