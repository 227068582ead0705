"""Rasters: GET /v1/grid."""

import asyncio
from decimal import ROUND_FLOOR, Context
from math import inf
from sys import float_info
from typing import Annotated, Any, Literal

from fastapi import APIRouter, Query, Response

from gpom_core.errors import InvalidQueryError
from gpom_core.member import Bounds
from gpom_core.snapshot import Snapshot, grid_shape
from service import nav2, piecewise, render
from service.errors import PayloadTooLargeError
from service.http.context import VERSION_HEADER, Service
from service.points import ABOUT_FUSION, NPY, Fusion, Method, write_npy
from service.raster_store import Raster

router = APIRouter(tags=["raster"])

MAX_AGE_S = 60.0
_DIGITS = Context(prec=3, rounding=ROUND_FLOOR)

Format = Literal["png", "npy", "nav2"]
_MEDIA: dict[Format, str] = {"png": "image/png", "npy": NPY, "nav2": "application/zip"}
_BINARY = {"schema": {"type": "string", "format": "binary"}}
_ANSWER: dict[int | str, dict[str, Any]] = {
    200: {
        "description": "One cell a pixel, evaluated at its centre. npy: float64 (rows, columns), "
        "row 0 at ymin. png: ymax on top. nav2: zip of "
        "pictures and YAML for map_server, occupancy as map.yaml and variance as variance.yaml.",
        "content": dict.fromkeys(_MEDIA.values(), _BINARY),
        "headers": {VERSION_HEADER: {"schema": {"type": "integer"}}},
    }
}


@router.get("/v1/grid", responses=_ANSWER, response_class=Response)
async def grid(  # noqa: PLR0913, PLR0917 - every parameter of the URL is an argument
    service: Service,
    bbox: Annotated[
        str | None,
        Query(
            description="xmin,ymin,xmax,ymax in m; without it `bounds` of /v1/status",
            examples=["-10,-5,10,5"],
        ),
    ] = None,
    resolution: Annotated[float, Query(description="edge of a cell in m")] = 0.1,
    layer: Annotated[
        render.Layer, Query(description="what a cell holds; of png and npy")
    ] = "occupancy",
    format: Annotated[  # noqa: A002 - the name in the URL
        Format, Query(description="a picture, numbers, or a map for Nav2")
    ] = "png",
    mode: Annotated[
        nav2.Mode, Query(description="of nav2: how map_server is to read occupancy")
    ] = "trinary",
    fusion: Annotated[Fusion, Query(description=ABOUT_FUSION)] = "bcm",
    method: Annotated[
        Method, Query(description="field: interpolated where much is asked for; or exact")
    ] = "field",
    max_age_s: Annotated[
        float,
        Query(
            ge=0.0,
            le=MAX_AGE_S,
            description="rather the last raster of this kind at once, if its version was the "
            "newest so long ago, than a wait for the newest",
        ),
    ] = 0.0,
) -> Response:
    """Draw a part of the map."""
    if format == "nav2" and layer != "occupancy":
        message = (
            f"layer is {layer} and format nav2, which holds occupancy and variance both: leave "
            "layer out, or ask for png or npy"
        )
        raise InvalidQueryError(message)
    snapshot = service.state.snapshot
    box = _bounds(bbox, snapshot)
    check_size(box, resolution, service.settings.http.grid_cells_max)

    def draw() -> bytes:
        cells = piecewise.grid(snapshot, box, resolution, fusion, service.queries.check, method)
        if format == "nav2":
            prior = snapshot.prior_variance
            return nav2.archive(cells, box, resolution, mode=mode, prior_variance=prior)
        if format == "npy":
            return write_npy(getattr(cells, layer).astype("<f8"))
        return render.png(cells, layer, snapshot.prior_variance)

    key = (box, resolution, layer, format, mode, fusion, method)
    raster = service.rasters.raster(key, snapshot.version, draw, max_age_s)
    if not isinstance(raster, Raster):
        # Others may wait for the same drawing, so one who goes away does not cancel it.
        raster = await asyncio.shield(asyncio.wrap_future(raster))
    headers = {VERSION_HEADER: str(raster.map_version)}
    return Response(raster.content, media_type=_MEDIA[format], headers=headers)


def _bounds(text: str | None, snapshot: Snapshot) -> Bounds:
    if text is None:
        if snapshot.extent is None:
            raise InvalidQueryError("the map is empty, so it has no bounds; name a bbox")
        return snapshot.extent
    try:
        xmin, ymin, xmax, ymax = map(float, text.split(","))
    except ValueError as error:
        message = f"bbox is {text!r}; expected xmin,ymin,xmax,ymax in m"
        raise InvalidQueryError(message) from error
    return xmin, ymin, xmax, ymax


def check_size(box: Bounds, resolution_m: float, cells_max: int) -> None:
    """Refuse a raster of too many cells.

    Raises:
        PayloadTooLargeError: it says what is allowed, and which resolution would be.
        InvalidQueryError: as `Snapshot.grid`.
    """
    rows: float
    columns: float
    try:
        rows, columns = grid_shape(box, resolution_m)
    except InvalidQueryError:
        # Perhaps for more cells than any raster may have; what holds here is less.
        if not resolution_m > 0.0:
            raise
        columns, rows = (box[2] - box[0]) / resolution_m, (box[3] - box[1]) / resolution_m
        if not (min(columns, rows) > 0.0 and cells_max < columns * rows < inf):
            raise
    if rows * columns > cells_max:
        message = (
            f"{columns:.0f} x {rows:.0f} cells; at most {cells_max} are allowed: ask for a smaller "
            f"bbox or a resolution from {_finest(box, cells_max)} m"
        )
        raise PayloadTooLargeError(message)


def _finest(box: Bounds, cells_max: int) -> str:
    """The finest resolution in m, of three digits, that is allowed: rounded, it might not be."""
    width_m, height_m = box[2] - box[0], box[3] - box[1]
    area = (width_m / cells_max) ** 0.5 * height_m**0.5
    # No raster of less is allowed; one of that may be not, for its last row and column.
    least = max(area, width_m / cells_max, height_m / cells_max, float_info.min)
    told = _DIGITS.create_decimal_from_float(least)
    while not _is_allowed(box, float(told), cells_max):
        told = _DIGITS.next_plus(told)
    return f"{float(told):.3g}".replace("e+", "e")  # in a URL + is a blank


def _is_allowed(box: Bounds, resolution_m: float, cells_max: int) -> bool:
    try:
        rows, columns = grid_shape(box, resolution_m)
    except InvalidQueryError:  # more than any raster may have
        return False
    return rows * columns <= cells_max
