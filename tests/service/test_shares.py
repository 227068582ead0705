"""One client's excess is told from a service that is short."""

import asyncio
import json

import pytest

from service.http.shares import Shares
from service.settings import HttpSettings

LIMITS = HttpSettings(client_requests_max=2, client_streams_max=1, retry_after_s=3)


class Desk:
    """An application that answers when it is let go, behind the shares of its clients."""

    def __init__(self) -> None:
        self.release = asyncio.Event()
        self.shares = Shares(self._answer, LIMITS)

    async def _answer(self, _scope, _receive, send) -> None:
        await self.release.wait()
        await send({"type": "http.response.start", "status": 200, "headers": []})

    async def ask(self, path: str, client: str = "10.0.0.1") -> tuple[dict, bytes]:
        sent: list[dict] = []

        async def send(message) -> None:
            sent.append(message)

        scope = {"type": "http", "path": path, "method": "GET", "client": (client, 1)}
        await self.shares(scope, None, send)
        return sent[0], sent[-1].get("body", b"")


async def _open(desk: Desk, *asked: tuple[str, str]) -> list[asyncio.Task]:
    tasks = [asyncio.create_task(desk.ask(*one)) for one in asked]
    await asyncio.sleep(0)
    return tasks


def test_who_asks_for_more_than_a_share_is_told_what_is_allowed_and_others_are_served() -> None:
    async def scene() -> None:
        desk = Desk()
        mine = await _open(desk, *[("/v1/query", "10.0.0.1")] * 2)
        start, body = await desk.ask("/v1/flush")
        problem = json.loads(body)
        assert start["status"] == problem["status"] == 429
        assert (b"retry-after", b"3") in start["headers"]
        assert problem["type"] == "urn:gpom:problem:excess"
        assert problem["allowed"] == 2
        assert "http.client_requests_max" in problem["detail"]
        others = await _open(
            desk, ("/v1/query", "10.0.0.2"), ("/v1/events", "10.0.0.1"), ("/readyz", "10.0.0.1")
        )
        assert (await desk.ask("/v1/events"))[0]["status"] == 429
        desk.release.set()
        replies = await asyncio.gather(*mine, *others)
        assert [start["status"] for start, _ in replies] == [200] * 5
        assert (await desk.ask("/v1/query"))[0]["status"] == 200

    asyncio.run(scene())


@pytest.mark.parametrize("path", ["/v1/query", "/v1/events"])
def test_a_client_that_went_away_leaves_its_share(path: str) -> None:
    async def scene() -> None:
        desk = Desk()
        for task in await _open(desk, *[(path, "10.0.0.1")] * 2):
            task.cancel()
        await asyncio.sleep(0)
        desk.release.set()
        assert (await desk.ask(path))[0]["status"] == 200

    asyncio.run(scene())
