"""How the map and the service are: status, flush, health, metrics."""

import asyncio
from typing import Annotated, Any, Literal

from fastapi import APIRouter, Body, Response
from prometheus_client import CONTENT_TYPE_LATEST
from pydantic import BaseModel, ConfigDict, Field

from gpom_core.errors import InvalidQueryError
from gpom_core.member import Bounds
from service.errors import FlushTimeoutError, NotReadyError
from service.http.context import Service
from service.map_service import MapService

router = APIRouter(tags=["status"])


class Intake(BaseModel):
    """Scans that come without a pose (ROS), before they are scans of the map."""

    received: int = Field(examples=[1210])
    waiting: int = Field(description="for their transforms", examples=[1])
    delayed: int = Field(description="that waited for a transform and got it", examples=[400])
    uncorrected: int = Field(description="with motion within the sweep left in", examples=[0])
    dropped: dict[str, int] = Field(description="by reason", examples=[{"no_transform": 9}])
    age_s: float | None = Field(
        description="of the last one by its own stamp when it came; far from 0, its clock is off"
    )
    problem: str | None = Field(
        description="what is wrong now, and since when; null while all is well",
        examples=["no transform from map to laser: no frame is called laser, since …"],
    )


class Robot(BaseModel):
    """One robot that was seen."""

    id: str = Field(examples=["robot-1"])
    scans: int = Field(description="accepted, over all runs", examples=[1200])
    lost: int = Field(description="told by gaps in the sequence numbers", examples=[3])
    last_seen: float | None = Field(
        description="Unix time in s of its last scan", examples=[1767225600.1]
    )
    pose: tuple[float, float, float] | None = Field(
        description="x m, y m, yaw rad (-π to π) of the sensor at its last scan",
        examples=[[1.0, 2.0, 0.5]],
    )
    alive: bool = Field(description="whether its liveliness token is up", examples=[True])
    intake: Intake | None = Field(description="null unless its scans come without a pose")
    refused: dict[str, int] = Field(
        description="scans that did not enter the map since the service started, by reason: "
        "`stale`, seen before or overtaken by a later one; `old_run`, the clock of the robot is "
        "behind that of its last run, which was heard less than 5 s ago, or another robot has its "
        "name; `out_of_order`, sent again after those before it; `too_many_beams`, stored, but "
        "over ingest.beams_max; `not_stored`, the journal is in trouble; or what is wrong with it",
        examples=[{"old_run": 12}],
    )


class Status(BaseModel):
    """The map at one moment."""

    map_version: int = Field(examples=[42])
    scans_received: int = Field(examples=[1203])
    scans_integrated: int = Field(examples=[1200])
    experts: int = Field(examples=[310])
    dirty_experts: int = Field(description="with evidence not in the answers yet", examples=[4])
    observations: int = Field(examples=[15000])
    robots: list[Robot]
    bounds: Bounds | None = Field(
        description="xmin, ymin, xmax, ymax of the evidence in m; null while there is none. "
        "Without what is more than 100 m from all else and less than 1 % of it",
        examples=[[-12.0, -7.5, 30.0, 22.0]],
    )
    experts_out_of_bounds: int = Field(
        description="left out of `bounds`: more than a few tell of a robot that is lost",
        examples=[0],
    )


_METRICS: dict[int | str, dict[str, Any]] = {
    200: {
        "description": "Prometheus' text format",
        "content": {
            "text/plain": {
                "schema": {"type": "string"},
                "example": "# TYPE gpom_map_version gauge\ngpom_map_version 42.0\n",
            }
        },
    }
}


class FlushRequest(BaseModel):
    """How long to wait."""

    model_config = ConfigDict(extra="forbid")

    timeout_s: float = Field(30.0, gt=0.0, description="then the answer is 504", examples=[30.0])


class Health(BaseModel):
    """It works; otherwise there is a problem, and `troubles` in it tell which."""

    status: Literal["ok"] = "ok"


@router.get("/v1/status", response_description="Counts, robots and the bounds of the map")
async def status(service: Service) -> Status:
    """Tell how much is in the map, and which robots feed it."""
    return _status(service)


@router.post("/v1/flush", response_description="The status, once nothing waits any more")
async def flush(service: Service, request: Annotated[FlushRequest | None, Body()] = None) -> Status:
    """Wait until all received so far is integrated and trained."""
    timeout_s = (request or FlushRequest()).timeout_s
    allowed_s = service.settings.http.flush_timeout_max_s
    if timeout_s > allowed_s:
        message = f"timeout_s is {timeout_s:g}; at most {allowed_s:g} is allowed"
        raise InvalidQueryError(message)
    try:
        async with asyncio.timeout(timeout_s):
            await asyncio.wrap_future(service.flush())
    except TimeoutError as error:
        state = service.state
        message = (
            f"after {timeout_s:g} s {service.scans_waiting} scans are not integrated and "
            f"{len(state.dirty)} experts are not trained; what is missing goes on being done"
        )
        raise FlushTimeoutError(message) from error
    return _status(service)


@router.get("/healthz", response_description="It answers")
async def healthz() -> Health:
    """Tell that the process answers."""
    return Health()


@router.get("/readyz", response_description="It does its work; if not, 503 and why")
async def readyz(service: Service) -> Health:
    """Tell whether scans can arrive, be stored, integrated and answered from, and if not why."""
    if troubles := service.troubles():
        raise NotReadyError(troubles)
    return Health()


@router.get("/metrics", response_class=Response, responses=_METRICS)
async def metrics(service: Service) -> Response:
    """Give Prometheus its numbers."""
    return Response(service.metrics.exposition(), media_type=CONTENT_TYPE_LATEST)


def _status(service: MapService) -> Status:
    state = service.state
    return Status(
        map_version=state.snapshot.version,
        scans_received=service.scans_received,
        scans_integrated=state.scans_integrated,
        experts=state.experts,
        dirty_experts=len(state.dirty),
        observations=state.observations,
        robots=[
            Robot(
                id=robot.id,
                scans=robot.scans,
                lost=robot.lost,
                last_seen=robot.last_seen_unix_s,
                pose=robot.pose,
                alive=robot.alive,
                intake=None
                if robot.intake is None
                else Intake(**{name: getattr(robot.intake, name) for name in Intake.model_fields}),
                refused=dict(robot.refused),
            )
            for robot in service.fleet.robots()
        ],
        bounds=state.snapshot.extent,
        experts_out_of_bounds=len(state.snapshot.members) - state.snapshot.main_count,
    )
