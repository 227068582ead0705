"""Server-sent events: GET /v1/events."""

import json
from collections.abc import AsyncIterator

from fastapi import APIRouter
from fastapi.responses import StreamingResponse

from service.events import Event, MapChanged, Subscription
from service.http.context import Service

router = APIRouter(tags=["events"])

_EXAMPLE = (
    'id: 42\nevent: map\ndata: {"map_version": 42, "changed": [-1.0, 0.0, 2.5, 4.0]}\n\n'
    'event: robot\ndata: {"robot": "robot-1", "alive": true}\n\n'
)


@router.get(
    "/v1/events",
    response_class=StreamingResponse,
    responses={
        200: {
            "description": "`map`: a new version and the area it changed (null: nothing yet); the "
            "first one is the map as it is. `robot`: one was seen first, came back or went. A slow "
            "reader gets the newest news, with the areas it missed merged into one.",
            "content": {"text/event-stream": {"example": _EXAMPLE}},
        }
    },
)
async def events(service: Service) -> StreamingResponse:
    """Follow the map as it changes."""
    subscription = service.events.subscribe()
    snapshot = service.state.snapshot
    subscription.put(MapChanged(snapshot.version, snapshot.bounds))
    stream = _lines(subscription, service.settings.http.event_keepalive_s)
    return StreamingResponse(
        stream, media_type="text/event-stream", headers={"Cache-Control": "no-store"}
    )


async def _lines(subscription: Subscription, keepalive_s: float) -> AsyncIterator[str]:
    with subscription:
        async for batch in subscription.batches(keepalive_s):
            yield "".join(map(_format, batch)) if batch else ": nothing new\n\n"


def _format(event: Event) -> str:
    if isinstance(event, MapChanged):
        data = {"map_version": event.map_version, "changed": event.changed}
        return f"id: {event.map_version}\nevent: map\ndata: {json.dumps(data)}\n\n"
    return f"event: robot\ndata: {json.dumps({'robot': event.robot, 'alive': event.alive})}\n\n"
