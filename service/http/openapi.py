"""What OpenAPI says beside the routes themselves, for the page GET /docs and for generators."""

from typing import Any

from fastapi import FastAPI
from fastapi.openapi.utils import get_openapi

from service.http.errors import ProblemDetails

SUMMARY = "One live, continuous occupancy map of a site, with its uncertainty"
_DESCRIPTION = """
Robots stream laser scans with poses; this service keeps **one map** of them and answers about any
place, at any resolution.

* Coordinates are **metres in the frame of the map**, angles are radians.
* `occupancy` is a probability. Where nobody has looked it is 0.5, `variance` is that of the prior
  and `known` is false: do not drive by occupancy alone.
* Every answer carries the **map version** it was made from, in its body or in the header
  `X-Gpom-Map-Version`. The version grows whenever something was learnt.
* Errors are problem details (RFC 9457): `title` says what, `detail` what to do about it. 503 with
  `Retry-After` means: the same again, a little later. 429 means that you have more open at once
  than one client may (`allowed`): wait for answers first.
* Where the service has tokens, send one as `Authorization: Bearer TOKEN`.

The live map for people is at [/](./), and the same questions can be asked over zenoh.
"""
_TAGS = [
    {"name": "query", "description": "What is at these points?"},
    {"name": "raster", "description": "Pictures and grids of an area, tiles, maps for Nav2."},
    {"name": "experts", "description": "The tracked lines that the map is made of."},
    {"name": "events", "description": "News as it happens, as server-sent events."},
    {"name": "status", "description": "How much is in the map, and how the service is."},
]


def describe(app: FastAPI, *, tokens: bool) -> None:
    """Let an application tell all of this at /openapi.json.

    Args:
        app: whose routes are told.
        tokens: whether it asks for tokens.
    """

    def openapi() -> dict[str, Any]:
        if app.openapi_schema is None:
            schema = get_openapi(
                title=app.title, version=app.version, summary=SUMMARY, description=_DESCRIPTION,
                tags=_TAGS, routes=app.routes,
                license_info={"name": "Apache-2.0", "identifier": "Apache-2.0"},
            )  # fmt: skip
            parts = schema.setdefault("components", {})
            parts.setdefault("schemas", {})["ProblemDetails"] = ProblemDetails.model_json_schema()
            if tokens:
                parts["securitySchemes"] = {"token": {"type": "http", "scheme": "bearer"}}
                schema["security"] = [{"token": []}]
            for operations in schema["paths"].values():
                for operation in operations.values():
                    _title(operation)
            app.openapi_schema = schema
        return app.openapi_schema

    app.openapi = openapi  # type: ignore[method-assign]


def _title(operation: dict[str, Any]) -> None:
    """Let the first sentence about it be the headline, not the name of its function."""
    first, _, rest = operation.pop("description").partition("\n\n")
    operation["summary"] = " ".join(first.split()).removesuffix(".")
    if rest:
        operation["description"] = rest
