"""Every error that gpom raises on purpose, as one tree.

GpomError
├── ConfigurationError   a setting is out of range, unknown or contradicts another
├── InvalidQueryError    points, box, resolution or fusion rule cannot be answered
└── InvalidScanError     a scan is malformed; `reason` is a short word for counters

Messages say what was wrong, what was expected and what to do.
"""


class GpomError(Exception):
    """Base of all errors that gpom raises on purpose."""


class ConfigurationError(GpomError):
    """A setting is out of range, unknown or contradicts another."""


class InvalidQueryError(GpomError):
    """A query cannot be answered as asked."""


class InvalidScanError(GpomError):
    """A scan that must not enter the map.

    Attributes:
        reason: one short word, stable, for counters and metrics (``bad_crc``, …).
    """

    def __init__(self, reason: str, message: str) -> None:
        super().__init__(message)
        self.reason = reason

    def __reduce__(self) -> tuple[type["InvalidScanError"], tuple[str, str]]:
        return type(self), (self.reason, str(self))
