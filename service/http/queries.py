"""Questions about points: POST and GET /v1/query."""

import asyncio
from typing import Annotated, Any

import numpy as np
from fastapi import APIRouter, Query, Request, Response
from fastapi.exceptions import RequestValidationError
from pydantic import BaseModel, Field, FiniteFloat, ValidationError

from service.errors import UnsupportedMediaError
from service.http.context import VERSION_HEADER, Service, agree, media_type
from service.points import (
    ABOUT_FUSION,
    JSON,
    NPY,
    Fusion,
    Method,
    PointsAnswer,
    PointsRequest,
    predict,
    read_request,
    write_answer,
)

router = APIRouter(tags=["query"])

_BINARY = {"schema": {"type": "string", "format": "binary"}}
_ANSWER: dict[int | str, dict[str, Any]] = {
    200: {
        "description": "One entry for each point, in the order asked; npy is float64 (N, 4) with "
        "columns occupancy, mean, variance, known",
        "model": PointsAnswer,
        "content": {
            JSON: {
                "example": {
                    "map_version": 42,
                    "occupancy": [0.03, 0.5],
                    "mean": [-0.94, 0.0],
                    "variance": [0.02, 1.0],
                    "known": [True, False],
                }
            },
            NPY: _BINARY,
        },
        "headers": {VERSION_HEADER: {"schema": {"type": "integer"}}},
    }
}
_BODY = {
    "requestBody": {
        "required": True,
        "content": {
            JSON: {
                "schema": PointsRequest.model_json_schema(),
                "example": {"points": [[0.0, 0.0], [1.5, -2.0]], "fusion": "bcm"},
            },
            NPY: {"schema": {**_BINARY["schema"], "description": "npy file, float64 (N, 2)"}},
        },
    }
}

_ABOUT_FUSION = f"{ABOUT_FUSION}; bcm unless it says otherwise"
_ABOUT_METHOD = "exact, unless it says field: interpolated, cheaper for many points"

FusionQuery = Annotated[Fusion | None, Query(description=_ABOUT_FUSION, examples=["bcm"])]
MethodQuery = Annotated[Method | None, Query(description=_ABOUT_METHOD)]


class _Point(BaseModel):
    x: FiniteFloat = Field(description="m in the map frame", examples=[1.5])
    y: FiniteFloat = Field(description="m in the map frame", examples=[-2.0])
    fusion: Fusion = Field("bcm", description=_ABOUT_FUSION)
    method: Method = Field("exact", description=_ABOUT_METHOD)


def _parameters(model: type[BaseModel]) -> dict[str, Any]:
    """Tell OpenAPI of parameters that the route reads by itself."""
    schema = model.model_json_schema()
    required = schema.get("required", ())
    return {
        "parameters": [
            {
                "name": name,
                "in": "query",
                "required": name in required,
                "description": about.pop("description"),
                "schema": about,
            }
            for name, about in schema["properties"].items()
        ]
    }


@router.post("/v1/query", responses=_ANSWER, openapi_extra=_BODY, response_class=Response)
async def query_points(
    request: Request, service: Service, fusion: FusionQuery = None, method: MethodQuery = None
) -> Response:
    """Ask about many points; answers come in the form of the question unless Accept differs."""
    asked_in = media_type(request)
    if asked_in not in {JSON, NPY}:
        message = f"Content-Type is {asked_in or 'missing'}; expected {JSON} or {NPY}"
        raise UnsupportedMediaError(message)
    answer_in = agree(request, (asked_in, NPY if asked_in == JSON else JSON))
    body = await request.body()
    snapshot = service.state.snapshot

    def answer() -> bytes:
        question = read_request(body, asked_in, fusion, method)
        points_max = service.settings.http.query_points_max
        prediction = predict(snapshot, question, points_max, service.queries.check)
        return write_answer(prediction, snapshot.version, answer_in)

    content = await asyncio.wrap_future(service.queries.submit(answer))
    return _respond(content, answer_in, snapshot.version)


@router.get(
    "/v1/query", responses=_ANSWER, openapi_extra=_parameters(_Point), response_class=Response
)
async def query_point(request: Request, service: Service) -> Response:
    """Ask about one point."""
    # Read here and not by FastAPI, which takes longer for the parameters than the map does for the
    # answer; and answered here and now, which is faster than a trip through the pool.
    try:
        asked = _Point.model_validate(dict(request.query_params))
    except ValidationError as error:
        where = [{**item, "loc": ("query", *item["loc"])} for item in error.errors()]
        raise RequestValidationError(where) from error
    answer_in = agree(request, (JSON, NPY))
    snapshot = service.state.snapshot
    prediction = snapshot.query(np.array([[asked.x, asked.y]]), asked.fusion, asked.method)
    return _respond(
        write_answer(prediction, snapshot.version, answer_in), answer_in, snapshot.version
    )


def _respond(content: bytes, media: str, map_version: int) -> Response:
    return Response(content, media_type=media, headers={VERSION_HEADER: str(map_version)})
