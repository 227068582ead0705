"""What one reader of GET /v1/events is told, and what it is not told twice."""

import json

import pytest

from service.http import streams


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> list[float]:
    now = [0.0]
    monkeypatch.setattr(streams.time, "monotonic", lambda: now[0])
    return now


def test_health_is_told_at_first_and_when_it_changes(clock: list[float]) -> None:
    troubles: list[str] = []
    news = streams.HealthNews(lambda: troubles)

    def told() -> list[str] | None:
        text = news.take()
        return json.loads(text.split("data: ")[1])["troubles"] if text else None

    assert told() == []
    troubles.append("the disk is full")
    assert told() is None, "not looked at again so soon"
    clock[0] += 1.0
    assert told() == ["the disk is full"]
    clock[0] += 1.0
    assert told() is None
    troubles.clear()
    clock[0] += 1.0
    assert told() == []
