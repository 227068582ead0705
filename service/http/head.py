"""HEAD wherever there is GET: the same but for the content (RFC 9110, section 9.3.2)."""

from starlette.types import ASGIApp, Message, Receive, Scope, Send


class Head:
    """ASGI middleware: routes see a GET, the client gets no content.

    An endless stream would never end for want of a reader, so it is told that the client has gone.
    """

    def __init__(self, app: ASGIApp) -> None:
        self._app = app

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Handle one connection."""
        if scope["type"] != "http" or scope["method"] != "HEAD":
            await self._app(scope, receive, send)
            return
        started = False
        inner = {**scope, "method": "GET"}

        async def gone() -> Message:
            return {"type": "http.disconnect"} if started else await receive()

        async def without_content(message: Message) -> None:
            nonlocal started
            if message["type"] == "http.response.start":
                started = True
                scope["route"] = inner.get("route")  # for who counts requests
                await send(message)
                await send({"type": "http.response.body", "body": b"", "more_body": False})

        await self._app(inner, gone, without_content)
