"""Counts and times requests, under the template of their route so that names stay few."""

import time

from starlette.types import ASGIApp, Message, Receive, Scope, Send

from service.metrics import Metrics


class Observe:
    """ASGI middleware. The time is that to the start of the answer: streams may last for days."""

    def __init__(self, app: ASGIApp, metrics: Metrics) -> None:
        self._app = app
        self._metrics = metrics

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Handle one connection."""
        if scope["type"] != "http":
            await self._app(scope, receive, send)
            return
        start_s = time.perf_counter()

        async def observed(message: Message) -> None:
            if message["type"] == "http.response.start":
                route = getattr(scope.get("route"), "path", "none")
                seconds = time.perf_counter() - start_s
                self._metrics.http_seconds.labels(route).observe(seconds)
                self._metrics.http_requests.labels(
                    route, _method(scope["method"]), message["status"]
                ).inc()
            await send(message)

        await self._app(scope, receive, observed)


def _method(method: str) -> str:
    known = {"GET", "POST", "HEAD", "OPTIONS", "PUT", "DELETE", "PATCH"}
    return method if method in known else "other"
