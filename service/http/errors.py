"""Every error leaves as problem details, also those that FastAPI and Starlette raise themselves."""

from http import HTTPStatus
from typing import Any

from fastapi import FastAPI, Request, Response
from fastapi.encoders import jsonable_encoder
from fastapi.exceptions import RequestValidationError
from fastapi.responses import JSONResponse
from pydantic import BaseModel, Field
from starlette.exceptions import HTTPException
from starlette.routing import Match, Route

from gpom_core.errors import GpomError, InvalidQueryError
from service.problems import KINDS, Kind, Problem, problem_of

_ERRORS_SHOWN_MAX = 20


class ProblemDetails(BaseModel):
    """RFC 9457 problem details."""

    type: str = Field(examples=["urn:gpom:problem:invalid-query"])
    title: str = Field(examples=["Invalid query"])
    status: int = Field(examples=[422])
    detail: str = Field(examples=["points hold NaN or infinity, expected finite metres"])


RESPONSES: dict[int | str, dict[str, Any]] = {
    "default": {
        "description": "Problem details (RFC 9457)",
        "content": {
            Problem.MEDIA_TYPE: {
                "schema": {"$ref": "#/components/schemas/ProblemDetails"},
                "example": {
                    "type": "urn:gpom:problem:too-large",
                    "title": "Request too large",
                    "status": 413,
                    "detail": "2000000 points in one query; at most 1000000 are allowed: split it",
                },
            }
        },
    }
}
"""For every route, in OpenAPI."""


def install(app: FastAPI) -> None:
    """Register the handlers."""
    app.add_exception_handler(GpomError, _on_error)
    app.add_exception_handler(RequestValidationError, _on_bad_request)
    app.add_exception_handler(HTTPException, _on_http_error)
    app.add_exception_handler(Exception, _on_error)


def respond(problem: Problem) -> Response:
    """Send a problem."""
    return JSONResponse(
        problem.document(),
        problem.kind.status,
        headers=problem.headers,
        media_type=Problem.MEDIA_TYPE,
    )


async def _on_error(_: Request, error: Exception) -> Response:
    return respond(problem_of(error))


async def _on_bad_request(_: Request, error: Exception) -> Response:
    if not isinstance(error, RequestValidationError):
        raise TypeError from error
    items = [
        {"where": ".".join(map(str, item["loc"])), "what": item["msg"]}
        for item in error.errors()[:_ERRORS_SHOWN_MAX]
    ]
    detail = "; ".join(f"{item['where']}: {item['what']}" for item in items)
    return respond(Problem(KINDS[InvalidQueryError], detail, {"errors": jsonable_encoder(items)}))


async def _on_http_error(request: Request, error: Exception) -> Response:
    if not isinstance(error, HTTPException):
        raise TypeError from error
    status = HTTPStatus(error.status_code)
    kind = Kind(status, f"http-{int(status)}", status.phrase)
    detail = f"{request.method} {request.url.path}: {error.detail}"
    headers = dict(error.headers or {})
    if status is HTTPStatus.METHOD_NOT_ALLOWED:
        # Starlette names the methods of one route, but the same path may have several.
        headers["Allow"] = ", ".join(sorted(_methods(request)))
    return respond(Problem(kind, detail, headers=headers))


def _methods(request: Request) -> set[str]:
    methods = {
        method
        for route in request.app.state.routes
        if isinstance(route, Route) and route.matches(request.scope)[0] is not Match.NONE
        for method in route.methods or ()
    }
    return methods | {"HEAD"} if "GET" in methods else methods
