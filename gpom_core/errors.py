"""Every error that gpom raises on purpose, as one tree.

GpomError
├── ConfigurationError     a setting is out of range, unknown or contradicts another
├── InvalidQueryError      points, box, resolution or fusion rule cannot be answered
├── InvalidScanError       a scan is malformed; `reason` is a short word for counters
├── InvalidTransformError  numbers that are no pose of one frame in another
├── RosMessageError        bytes that are no ROS message of the expected type; with a `reason`
└── UnknownPoseError       where a frame is at a moment cannot be told; with a `reason`

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


class InvalidTransformError(GpomError):
    """Numbers that are no pose of one frame in another."""


class RosMessageError(GpomError):
    """Bytes that are no ROS message of the expected type.

    Attributes:
        reason: one short word, stable, for counters and metrics (``bad_cdr``, …).
    """

    def __init__(self, reason: str, message: str) -> None:
        super().__init__(message)
        self.reason = reason


class UnknownPoseError(GpomError):
    """Where a frame is at a moment cannot be told.

    Attributes:
        reason: ``unconnected``, ``too_new`` or ``too_old``.
    """

    def __init__(self, reason: str, message: str) -> None:
        super().__init__(message)
        self.reason = reason
