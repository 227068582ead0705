"""Errors as RFC 9457 problem details: one table from exception to status, for HTTP and zenoh."""

import json
from dataclasses import dataclass, field
from http import HTTPStatus
from typing import Any, ClassVar

from gpom_core.errors import (
    ConfigurationError,
    GpomError,
    InvalidQueryError,
    InvalidScanError,
    InvalidTransformError,
    RosMessageError,
    UnknownPoseError,
)
from gpom_core.expert import TrainingError
from gpom_core.image import InvalidImageError
from service.errors import (
    BodyTimeoutError,
    BusyError,
    ExcessError,
    FlushTimeoutError,
    ForbiddenError,
    JournalError,
    MapFileError,
    NotAcceptableError,
    NotReadyError,
    PayloadTooLargeError,
    SourceError,
    StoppingError,
    UnauthorizedError,
    UnsupportedMediaError,
)


@dataclass(frozen=True, slots=True)
class Kind:
    """What all problems of one kind share."""

    status: HTTPStatus
    name: str
    title: str


KINDS: dict[type[GpomError], Kind] = {
    GpomError: Kind(HTTPStatus.INTERNAL_SERVER_ERROR, "internal", "The service failed"),
    BodyTimeoutError: Kind(HTTPStatus.REQUEST_TIMEOUT, "body-timeout", "Not sent in time"),
    BusyError: Kind(HTTPStatus.SERVICE_UNAVAILABLE, "busy", "Too much at once"),
    ConfigurationError: Kind(HTTPStatus.INTERNAL_SERVER_ERROR, "configuration", "Bad settings"),
    ExcessError: Kind(HTTPStatus.TOO_MANY_REQUESTS, "excess", "Too much from one client"),
    FlushTimeoutError: Kind(HTTPStatus.GATEWAY_TIMEOUT, "flush-timeout", "Not done in time"),
    ForbiddenError: Kind(HTTPStatus.FORBIDDEN, "forbidden", "Not allowed"),
    UnauthorizedError: Kind(HTTPStatus.UNAUTHORIZED, "unauthorized", "Token needed"),
    InvalidQueryError: Kind(HTTPStatus.UNPROCESSABLE_ENTITY, "invalid-query", "Invalid query"),
    InvalidScanError: Kind(HTTPStatus.UNPROCESSABLE_ENTITY, "invalid-scan", "Invalid scan"),
    InvalidTransformError: Kind(
        HTTPStatus.UNPROCESSABLE_ENTITY, "invalid-transform", "Invalid transform"
    ),
    JournalError: Kind(HTTPStatus.SERVICE_UNAVAILABLE, "journal", "Scans cannot be stored"),
    MapFileError: Kind(HTTPStatus.INTERNAL_SERVER_ERROR, "map-file", "Bad map file"),
    InvalidImageError: Kind(HTTPStatus.INTERNAL_SERVER_ERROR, "image", "Bad state of a map"),
    NotAcceptableError: Kind(HTTPStatus.NOT_ACCEPTABLE, "not-acceptable", "No such form of answer"),
    NotReadyError: Kind(HTTPStatus.SERVICE_UNAVAILABLE, "not-ready", "Not ready"),
    PayloadTooLargeError: Kind(
        HTTPStatus.REQUEST_ENTITY_TOO_LARGE, "too-large", "Request too large"
    ),
    RosMessageError: Kind(
        HTTPStatus.UNPROCESSABLE_ENTITY, "ros-message", "No ROS message of this type"
    ),
    SourceError: Kind(HTTPStatus.SERVICE_UNAVAILABLE, "source", "Scans cannot arrive"),
    StoppingError: Kind(HTTPStatus.SERVICE_UNAVAILABLE, "stopping", "Shutting down"),
    TrainingError: Kind(HTTPStatus.INTERNAL_SERVER_ERROR, "training", "Training failed"),
    UnknownPoseError: Kind(
        HTTPStatus.UNPROCESSABLE_ENTITY, "unknown-pose", "Where the sensor was is not known"
    ),
    UnsupportedMediaError: Kind(
        HTTPStatus.UNSUPPORTED_MEDIA_TYPE, "unsupported-media", "Media type not understood"
    ),
}


@dataclass(frozen=True, slots=True)
class Problem:
    """One problem, as RFC 9457 wants it told."""

    MEDIA_TYPE: ClassVar[str] = "application/problem+json"

    kind: Kind
    detail: str
    extensions: dict[str, Any] = field(default_factory=dict)
    headers: dict[str, str] = field(default_factory=dict)

    def encoded(self) -> bytes:
        """The same as JSON, for where there is no HTTP."""
        return json.dumps(self.document()).encode()

    def document(self) -> dict[str, Any]:
        """The members of the problem details object."""
        return {
            "type": f"urn:gpom:problem:{self.kind.name}",
            "title": self.kind.title,
            "status": int(self.kind.status),
            "detail": self.detail,
            **self.extensions,
        }


def problem_of(error: BaseException) -> Problem:
    """Describe an error; what was not raised on purpose says nothing about the inside."""
    if not isinstance(error, GpomError):
        return Problem(KINDS[GpomError], "unexpected error; the log of the service has the cause")
    kind = next(KINDS[cls] for cls in type(error).__mro__ if cls in KINDS)
    if isinstance(error, BusyError):
        return _later(kind, error, error.retry_after_s)
    if isinstance(error, ExcessError):
        return _later(kind, error, error.retry_after_s, allowed=error.allowed)
    if isinstance(error, UnauthorizedError):
        return Problem(kind, str(error), headers={"WWW-Authenticate": "Bearer"})
    if isinstance(error, NotReadyError):
        return _later(kind, error, 1, troubles=error.troubles)
    return Problem(kind, str(error))


def _later(kind: Kind, error: GpomError, retry_after_s: int, **more: Any) -> Problem:
    """When to try again is told twice: zenoh has no headers."""
    headers = {"Retry-After": str(retry_after_s)}
    return Problem(kind, str(error), {**more, "retry_after_s": retry_after_s}, headers)
