"""Server-sent events: GET /v1/events."""

import json
import time
from collections.abc import AsyncIterator, Callable, Sequence

from fastapi import APIRouter
from fastapi.responses import StreamingResponse

from service.events import Event, MapChanged, Subscription
from service.fleet import Fleet, RobotStatus
from service.http.context import Service

router = APIRouter(tags=["events"])

_TICK_S = 0.15  # robots are looked at so often: ingest spends nothing on those who watch
_HEALTH_S = 1.0

_EXAMPLE = (
    'id: 42\nevent: map\ndata: {"map_version": 42, "changed": [-1.0, 0.0, 2.5, 4.0]}\n\n'
    'event: robot\ndata: {"robot": "robot-1", "alive": true}\n\n'
    'event: poses\ndata: {"time": 1767225600.2, "robots": [{"id": "robot-1", "pose": '
    '[1.0, 2.0, 0.5], "last_seen": 1767225600.1, "scans": 1200, "alive": true}]}\n\n'
    'event: health\ndata: {"troubles": ["no space left on device"]}\n\n'
)


@router.get(
    "/v1/events",
    response_class=StreamingResponse,
    responses={
        200: {
            "description": "`map`: a new version and the area it changed (null: nothing yet); the "
            "first one is the map as it is. `robot`: one was seen first, came back or went. "
            "`poses`: robots that sent scans since the last one, a few times a second, none from "
            "time to time; `time` is the server's. `health`: "
            "what /readyz says, when it changes. A slow reader gets the newest news, with the "
            "areas it missed merged into one.",
            "content": {"text/event-stream": {"example": _EXAMPLE}},
        }
    },
)
async def events(service: Service) -> StreamingResponse:
    """Follow the map and the robots as they change."""
    subscription = service.events.subscribe()
    snapshot = service.state.snapshot
    subscription.put(MapChanged(snapshot.version, snapshot.bounds))
    poses = PoseNews(service.fleet, service.settings.http.event_keepalive_s)
    stream = _lines(subscription, poses, HealthNews(service.troubles))
    return StreamingResponse(
        stream,
        media_type="text/event-stream",
        headers={"Cache-Control": "no-store", "X-Accel-Buffering": "no"},
    )


class PoseNews:
    """Tells one reader which robots moved since it was told last, and at times that none did."""

    def __init__(self, fleet: Fleet, heartbeat_s: float) -> None:
        self._fleet = fleet
        self._heartbeat_s = heartbeat_s
        self._told: dict[str, RobotStatus] = {}
        self._told_s = float("-inf")

    def take(self) -> str:
        """Give an event, or nothing when there is no need for one."""
        # An unchanged robot is the very same object, and most are.
        moved = [robot for robot in self._fleet.robots() if self._told.get(robot.id) is not robot]
        now_s = time.monotonic()
        if not moved and now_s - self._told_s < self._heartbeat_s:
            return ""
        self._told_s = now_s
        self._told.update((robot.id, robot) for robot in moved)
        data = {"time": time.time(), "robots": [_robot(robot) for robot in moved]}
        return f"event: poses\ndata: {json.dumps(data)}\n\n"


class HealthNews:
    """Tells one reader what keeps the service from its work, at first and whenever it changes."""

    def __init__(self, troubles: Callable[[], Sequence[str]]) -> None:
        self._troubles = troubles
        self._told: list[str] | None = None
        self._look_s = float("-inf")

    def take(self) -> str:
        """Give an event, or nothing when there is no need for one."""
        now_s = time.monotonic()
        if now_s < self._look_s:
            return ""
        self._look_s = now_s + _HEALTH_S
        troubles = list(self._troubles())
        if troubles == self._told:
            return ""
        self._told = troubles
        return f"event: health\ndata: {json.dumps({'troubles': troubles})}\n\n"


async def _lines(
    subscription: Subscription, poses: PoseNews, health: HealthNews
) -> AsyncIterator[str]:
    with subscription:
        async for batch in subscription.batches(_TICK_S):
            if text := "".join(map(_format, batch)) + poses.take() + health.take():
                yield text


def _robot(robot: RobotStatus) -> dict[str, object]:
    return {
        "id": robot.id,
        "pose": robot.pose,
        "last_seen": robot.last_seen_unix_s,
        "scans": robot.scans,
        "alive": robot.alive,
    }


def _format(event: Event) -> str:
    if isinstance(event, MapChanged):
        data = {"map_version": event.map_version, "changed": event.changed}
        return f"id: {event.map_version}\nevent: map\ndata: {json.dumps(data)}\n\n"
    return f"event: robot\ndata: {json.dumps({'robot': event.robot, 'alive': event.alive})}\n\n"
