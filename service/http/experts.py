"""The experts of the map: GET /v1/experts, also as GeoJSON."""

import json
from typing import Annotated, Any, Literal

from fastapi import APIRouter, Query, Request, Response
from pydantic import BaseModel, Field

from service.http.context import Service, agree
from service.mapping import MapState
from service.points import JSON

router = APIRouter(tags=["experts"])

GEOJSON = "application/geo+json"
_MEDIA = {"json": JSON, "geojson": GEOJSON}


class Expert(BaseModel):
    """The Gaussian process of one cluster, as trained last."""

    cluster_id: int = Field(examples=[7])
    line: tuple[tuple[float, float], tuple[float, float]] = Field(
        description="its ends, m", examples=[[[1.0, 2.0], [3.5, 2.0]]]
    )
    observations: int = Field(description="hits and free areas, merged", examples=[72])
    hits: int = Field(description="merged, one for each place", examples=[31])
    length_scale_m: float = Field(examples=[0.15])
    signal_std: float = Field(examples=[1.0])
    revision: int = Field(description="of the evidence it was trained on")
    dirty: bool = Field(description="newer evidence waits to be trained")


class SetAside(BaseModel):
    """A cluster whose training failed again and again; tried again when its evidence changes."""

    cluster_id: int
    revision: int
    error: str


class Experts(BaseModel):
    """All experts of one version."""

    map_version: int
    experts: list[Expert]
    quarantined: list[SetAside]


_ANSWER: dict[int | str, dict[str, Any]] = {
    200: {
        "model": Experts,
        "description": "json, or GeoJSON: a FeatureCollection with the line of each expert, its "
        "coordinates in m in the map frame and everything else as properties",
        "content": {
            GEOJSON: {
                "example": {
                    "type": "FeatureCollection",
                    "map_version": 42,
                    "features": [
                        {
                            "type": "Feature",
                            "id": 7,
                            "geometry": {
                                "type": "LineString",
                                "coordinates": [[1.0, 2.0], [3.5, 2.0]],
                            },
                            "properties": {"hits": 90, "dirty": False},
                        }
                    ],
                }
            }
        },
    }
}


@router.get("/v1/experts", responses=_ANSWER, response_class=Response)
def experts(
    request: Request,
    service: Service,
    format: Annotated[  # noqa: A002 - the name in the URL
        Literal["json", "geojson"] | None, Query(description="stronger than the Accept header")
    ] = None,
) -> Response:
    """List the experts that answer questions, as numbers or as lines to draw."""
    wanted = agree(request, (JSON, GEOJSON)) if format is None else _MEDIA[format]
    answer = _experts(service.state)
    if wanted == GEOJSON:
        return Response(json.dumps(_features(answer)), media_type=GEOJSON)
    return Response(answer.model_dump_json(), media_type=JSON)


def _experts(state: MapState) -> Experts:
    return Experts(
        map_version=state.snapshot.version,
        experts=[
            Expert(
                cluster_id=expert.cluster_id,
                line=expert.line,
                observations=expert.observations,
                hits=expert.hits,
                length_scale_m=expert.length_scale_m,
                signal_std=expert.signal_std,
                revision=expert.revision,
                dirty=expert.cluster_id in state.dirty,
            )
            for expert in state.snapshot.experts()
        ],
        quarantined=[
            SetAside(cluster_id=q.cluster_id, revision=q.revision, error=q.error)
            for q in state.quarantined
        ],
    )


def _features(answer: Experts) -> dict[str, Any]:
    return {
        "type": "FeatureCollection",
        "map_version": answer.map_version,
        "features": [
            {
                "type": "Feature",
                "id": expert.cluster_id,
                "geometry": {"type": "LineString", "coordinates": expert.line},
                "properties": expert.model_dump(exclude={"line"}),
            }
            for expert in answer.experts
        ],
    }
