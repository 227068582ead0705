"""One client, known by its address, takes a share of the service and not all of it.

What it asks beyond is its own excess: 429, where a service that is short says 503. Behind a proxy
on this machine the address is that which the proxy forwards (X-Forwarded-For).
"""

from collections import Counter

from starlette.types import ASGIApp, Receive, Scope, Send

from service.errors import ExcessError
from service.http.errors import respond
from service.problems import problem_of
from service.settings import HttpSettings

_STREAMS = "/v1/events"


class Shares:
    """ASGI middleware. A request counts until its answer has ended or its client has gone."""

    def __init__(self, app: ASGIApp, http: HttpSettings) -> None:
        self._app = app
        self._http = http
        self._open: Counter[tuple[str, bool]] = Counter()

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Handle one connection."""
        if scope["type"] != "http" or not scope["path"].startswith("/v1/"):
            await self._app(scope, receive, send)
            return
        client = scope.get("client")
        share = (client[0] if client else "", scope["path"] == _STREAMS)
        if (excess := self._excess(share)) is not None:
            await respond(problem_of(excess))(scope, receive, send)
            return
        self._open[share] += 1
        try:
            await self._app(scope, receive, send)
        finally:
            self._open[share] -= 1
            if not self._open[share]:
                del self._open[share]  # or every address that ever asked would be remembered

    def _excess(self, share: tuple[str, bool]) -> ExcessError | None:
        name, what = (
            ("client_streams_max", "event streams")
            if share[1]
            else ("client_requests_max", "requests")
        )
        allowed: int = getattr(self._http, name)
        if self._open[share] < allowed:
            return None
        message = (
            f"this client has {self._open[share]} {what} open, and {allowed} are allowed at once "
            f"(setting http.{name}): wait for their answers, or close some"
        )
        return ExcessError(message, allowed, self._http.retry_after_s)
