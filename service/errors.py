"""What can go wrong in the running process, as leaves of the tree in gpom_core.errors.

GpomError
├── BodyTimeoutError       a request did not come whole in time
├── BusyError              more work than the service takes on at once; come back later
├── ExcessError            more at once than one client may ask; come back later
├── ForbiddenError         the token of the request does not allow this
├── FlushTimeoutError      not everything received was integrated and trained in time
├── JournalError           scans could not be stored, so they were not accepted
├── MapFileError           a checkpoint or an exported map cannot be read or written
├── NotReadyError          scans cannot arrive, be stored or be integrated at the moment
├── NotAcceptableError     an answer was asked for in a form that is not offered
├── PayloadTooLargeError   more points, cells or bytes than one request may have
├── SourceError            the way by which scans arrive could not be opened
├── StoppingError          the service is shutting down
├── UnauthorizedError      a token is needed, and none or a wrong one came
└── UnsupportedMediaError  a request came in a form that is not understood

`service.http.problems` gives each its HTTP status.
"""

from gpom_core.errors import GpomError


class BodyTimeoutError(GpomError):
    """A request did not come whole in time."""


class BusyError(GpomError):
    """More work than the service takes on at once.

    Attributes:
        retry_after_s: when to try again.
    """

    def __init__(self, message: str, retry_after_s: int = 1) -> None:
        super().__init__(message)
        self.retry_after_s = retry_after_s


class ExcessError(GpomError):
    """More at once than one client may ask, however idle the service is.

    Attributes:
        allowed: how much it may.
        retry_after_s: when to try again.
    """

    def __init__(self, message: str, allowed: int, retry_after_s: int = 1) -> None:
        super().__init__(message)
        self.allowed = allowed
        self.retry_after_s = retry_after_s


class FlushTimeoutError(GpomError):
    """Not everything received was integrated and trained in time."""


class ForbiddenError(GpomError):
    """The token of the request does not allow this."""


class JournalError(GpomError):
    """Scans could not be stored, so they were not accepted."""


class MapFileError(GpomError):
    """A checkpoint or an exported map cannot be read or written."""


class NotReadyError(GpomError):
    """Scans cannot arrive, be stored or be integrated at the moment.

    Attributes:
        troubles: all that is wrong.
    """

    def __init__(self, troubles: list[str]) -> None:
        super().__init__("; ".join(troubles))
        self.troubles = troubles


class NotAcceptableError(GpomError):
    """An answer was asked for in a form that is not offered."""


class PayloadTooLargeError(GpomError):
    """More points, cells or bytes than one request may have."""


class SourceError(GpomError):
    """The way by which scans arrive could not be opened."""


class StoppingError(GpomError):
    """The service is shutting down."""


class UnauthorizedError(GpomError):
    """A token is needed, and none or a wrong one came."""


class UnsupportedMediaError(GpomError):
    """A request came in a form that is not understood."""
