"""Errors of the clients, as branches of the one tree of gpom.

GpomError
├── LogReadError                a log cannot be read as a log of laser scans
├── DeliveryError               scans do not reach the map: no router, no map service, link lost
│   ├── OutboxFullError         no room for another scan in time
│   ├── OutboxStorageError      the outbox on disk cannot be used
│   ├── ScanDroppedError        the outbox dropped this scan to make room, as told
│   └── SupersededError         another publisher has taken over this robot's name
├── UnknownScanError            asked about a scan that was never published; a ValueError too
└── MapServiceError             the map's HTTP interface gave no answer that can be used
    ├── MapRequestError         4xx: the question is refused as asked
    ├── MapUnavailableError     5xx, 429: the service cannot answer now
    ├── MapProtocolError        whatever answers is not a map service of this version
    └── MapUnreachableError     no answer at all: refused, wrong address, connection lost
        └── MapTimeoutError     no answer in time

`exit_code` is what the command line returns: 2 for what the user can correct in the command,
1 for what failed while running.
"""

from gpom_core.errors import GpomError

USAGE_EXIT_CODE = 2
RUNTIME_EXIT_CODE = 1


class LogReadError(GpomError):
    """A log cannot be read as a log of laser scans."""


class DeliveryError(GpomError):
    """Scans do not reach the map: no router, no map service, or the link is lost."""

    exit_code = RUNTIME_EXIT_CODE


class OutboxFullError(DeliveryError):
    """There was no room for another scan in time."""


class OutboxStorageError(DeliveryError):
    """The outbox on disk cannot be read or written."""


class ScanDroppedError(DeliveryError):
    """The outbox dropped this scan to make room, as its policy says."""


class SupersededError(DeliveryError):
    """Another publisher has taken over the stream: two robots have the same name."""


class UnknownScanError(GpomError, ValueError):
    """No scan that this publisher knows has the number that was asked about."""


class MapServiceError(GpomError):
    """The map's HTTP interface gave no answer that can be used.

    Attributes:
        status: HTTP status, or None when there was no answer.
        title: what kind of problem it is, short and stable (RFC 9457 `title`).
        detail: what was wrong this time (RFC 9457 `detail`).
    """

    exit_code = RUNTIME_EXIT_CODE

    def __init__(self, status: int | None, title: str, detail: str) -> None:
        super().__init__(status, title, detail)
        self.status = status
        self.title = title
        self.detail = detail

    def __str__(self) -> str:
        code = "" if self.status is None else f" (HTTP {self.status})"
        return f"{self.title}{code}: {self.detail}" if self.detail else f"{self.title}{code}"


class MapRequestError(MapServiceError):
    """The service refuses the question as asked."""

    exit_code = USAGE_EXIT_CODE


class MapUnavailableError(MapServiceError):
    """The service is there but cannot answer now."""


class MapProtocolError(MapServiceError):
    """Whatever answers at this address does not speak the map's interface."""


class MapUnreachableError(MapServiceError):
    """Nothing answers at this address."""


class MapTimeoutError(MapUnreachableError):
    """No answer came in time."""
