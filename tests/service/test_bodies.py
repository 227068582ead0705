"""No route takes more into memory than one request may have, whoever reads the body."""

import asyncio
import json

import pytest
from fastapi import Body, FastAPI, Request

from service.http import errors
from service.http.bodies import Bodies


async def ask(path: str, sizes: list[int], stated: int | None) -> tuple[int, dict, int]:
    """Post a body in parts of these sizes; the status, the answer, and the parts that were read."""
    app = FastAPI()
    errors.install(app)

    @app.post("/whole")
    async def whole(request: Request) -> dict[str, int]:
        return {"read": len(await request.body())}

    @app.post("/parsed")
    async def parsed(value: str = Body()) -> dict[str, int]:
        return {"read": len(value) + 2}

    waiting, sent = list(sizes), []

    async def receive() -> dict:
        part = b'"' * waiting.pop(0) if waiting else b""
        return {"type": "http.request", "body": part, "more_body": bool(waiting)}

    async def send(message: dict) -> None:
        sent.append(message)

    headers = [(b"content-type", b"application/json")]
    if stated is not None:
        headers.append((b"content-length", b"%d" % stated))
    scope = {
        "type": "http",
        "method": "POST",
        "path": path,
        "query_string": b"",
        "headers": headers,
    }
    await Bodies(app, 100)(scope, receive, send)
    content = b"".join(message.get("body", b"") for message in sent)
    return sent[0]["status"], json.loads(content), len(sizes) - len(waiting)


@pytest.mark.parametrize("path", ["/whole", "/parsed"])
def test_a_body_is_refused_where_it_gets_too_large(path) -> None:
    status, problem, read = asyncio.run(ask(path, [60] * 9, None))
    assert status == problem["status"] == 413
    assert "100 bytes" in problem["detail"]
    assert read == 2


@pytest.mark.parametrize("path", ["/whole", "/parsed"])
def test_a_body_that_says_so_is_refused_unread(path) -> None:
    status, _, read = asyncio.run(ask(path, [60, 60], 120))
    assert (status, read) == (413, 0)


def test_what_is_allowed_passes() -> None:
    assert asyncio.run(ask("/whole", [60, 40], 100)) == (200, {"read": 100}, 2)
    assert asyncio.run(ask("/parsed", [2], 2))[:2] == (200, {"read": 2})
