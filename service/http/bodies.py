"""Bodies within bounds, on every route: no more is taken into memory than one request may have."""

from starlette.datastructures import Headers
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from service.errors import PayloadTooLargeError
from service.http.errors import respond
from service.problems import problem_of


class Bodies:
    """ASGI middleware. A body that is too large is refused unread, or where it gets too large."""

    def __init__(self, app: ASGIApp, bytes_max: int) -> None:
        self._app = app
        self._bytes_max = bytes_max

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Handle one connection."""
        if scope["type"] != "http":
            await self._app(scope, receive, send)
            return
        stated = Headers(scope=scope).get("content-length", "")
        if stated.isdigit() and int(stated) > self._bytes_max:
            await respond(problem_of(self._too_large()))(scope, receive, send)
            return
        size = 0

        async def counted() -> Message:
            nonlocal size
            part = await receive()
            size += len(part.get("body", b""))
            if size > self._bytes_max:
                raise self._too_large()
            return part

        async def unless_too_large(part: Message) -> None:
            # Whoever reads the body may call the error by another name.
            if size <= self._bytes_max:
                await send(part)

        await self._app(scope, counted, unless_too_large)
        if size > self._bytes_max:
            await respond(problem_of(self._too_large()))(scope, receive, send)

    def _too_large(self) -> PayloadTooLargeError:
        return PayloadTooLargeError(
            f"the body is larger than the {self._bytes_max} bytes that are allowed: split the query"
        )
