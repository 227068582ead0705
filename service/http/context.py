"""What handlers share: the service behind the app, agreed media types."""

from collections.abc import Iterable
from typing import Annotated

from fastapi import Depends, Request

from service.errors import NotAcceptableError
from service.map_service import MapService

VERSION_HEADER = "X-Gpom-Map-Version"


async def _service(request: Request) -> MapService:
    # Not async, it would be called in a thread of a pool: half the time of a query of one point.
    service: MapService = request.app.state.service
    return service


Service = Annotated[MapService, Depends(_service)]


def media_type(request: Request) -> str:
    """The media type of the body, without parameters; empty when not stated."""
    return request.headers.get("content-type", "").split(";")[0].strip().lower()


def agree(request: Request, offered: Iterable[str]) -> str:
    """Pick the form of the answer that the client likes best; the first offered in doubt.

    Several Accept headers are one list (RFC 9110, section 5.3).

    Raises:
        NotAcceptableError: the Accept header wants none of them.
    """
    offers = list(offered)
    header = ", ".join(filter(str.strip, request.headers.getlist("accept"))) or "*/*"
    wanted = [_weighted(part) for part in header.split(",")]
    best = max(offers, key=lambda offer: _quality(offer, wanted))
    if _quality(best, wanted) <= 0.0:
        message = f"Accept is {header!r}; offered here: {', '.join(offers)}"
        raise NotAcceptableError(message)
    return best


def _weighted(part: str) -> tuple[str, float]:
    name, *parameters = (piece.strip().lower() for piece in part.split(";"))
    for parameter in parameters:
        if parameter.startswith("q="):
            try:
                return name, float(parameter[2:])
            except ValueError:
                return name, 0.0
    return name, 1.0


def _quality(offer: str, wanted: Iterable[tuple[str, float]]) -> float:
    """Give the weight of the most specific range that fits (RFC 9110, section 12.5.1)."""
    family = offer.partition("/")[0] + "/*"
    fits = [
        (specificity, quality)
        for name, quality in wanted
        for specificity, pattern in ((2, offer), (1, family), (0, "*/*"))
        if name == pattern
    ]
    return max(fits)[1] if fits else 0.0
