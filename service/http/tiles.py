"""Tiles of a slippy map: GET /v1/tiles/{layer}/{z}/{x}/{y}.png."""

import asyncio
from dataclasses import replace
from typing import Annotated, Any

from fastapi import APIRouter, Header, Path, Query, Response

from service.http.context import VERSION_HEADER, Service
from service.tile_raster import Theme, TileLayer
from service.tile_scheme import INDEX_MAX, ZOOM_MAX, ZOOM_MIN, TileAddress
from service.tile_store import TileKey

router = APIRouter(tags=["raster"])

_HEADERS = {
    VERSION_HEADER: {"schema": {"type": "integer"}},
    "ETag": {
        "schema": {"type": "string"},
        "description": "changes when something under this tile does, and not before",
    },
}
_ANSWER: dict[int | str, dict[str, Any]] = {
    200: {
        "description": "256 x 256 pixels, 2^z of them to the metre, as Leaflet's CRS.Simple with "
        "y as latitude: tile (x, y) spans x * 256 / 2^z to (x + 1) * 256 / 2^z m eastwards and "
        "-(y + 1) * 256 / 2^z to -y * 256 / 2^z m northwards. The unknown is transparent.",
        "content": {"image/png": {"schema": {"type": "string", "format": "binary"}}},
        "headers": _HEADERS,
    },
    304: {"description": "the tile that If-None-Match names is still the newest"},
}

Column = Annotated[
    int, Path(ge=-INDEX_MAX, le=INDEX_MAX, description="column, eastwards", examples=[0])
]
Row = Annotated[
    int,
    Path(
        ge=-INDEX_MAX,
        le=INDEX_MAX,
        description="row, southwards; negative north of the origin",
        examples=[-1],
    ),
]


@router.get("/v1/tiles/{layer}/{z}/{x}/{y}.png", responses=_ANSWER, response_class=Response)
async def tile(
    service: Service,
    layer: Annotated[TileLayer, Path(description="state: free, occupied or unknown")],
    z: Annotated[
        int, Path(ge=ZOOM_MIN, le=ZOOM_MAX, description="2^z pixels to the metre", examples=[4])
    ],
    x: Column,
    y: Row,
    theme: Annotated[Theme, Query(description="background that the colours are for")] = "light",
    draft: Annotated[
        bool, Query(description="rather a coarse picture at once, without an ETag, than a wait")
    ] = False,
    if_none_match: Annotated[
        str | None, Header(description="ETag of the tile that is here already")
    ] = None,
) -> Response:
    """Draw one tile of the live map."""
    store = service.tiles
    stamps = store.stamps(service.state.snapshot)
    key = TileKey(TileAddress(z, x, y), layer, theme, stamps.of(TileAddress(z, x, y)))
    etag = f'"{service.instance}.{key.stamp}"'
    headers = {
        VERSION_HEADER: str(stamps.snapshot.version),
        "ETag": etag,
        # Keep it, but ask each time whether it is still the newest: the answer is short.
        "Cache-Control": "no-cache",
    }
    if if_none_match is not None and _matches(etag, if_none_match):
        return Response(status_code=304, headers=headers)
    if draft and not store.has(key):
        key = replace(key, draft=True)
        headers = {VERSION_HEADER: headers[VERSION_HEADER], "Cache-Control": "no-store"}
    picture = store.picture(key, stamps.snapshot)
    if not isinstance(picture, bytes):
        # Others may wait for the same drawing, so one who goes away does not cancel it.
        picture = await asyncio.shield(asyncio.wrap_future(picture))
    return Response(picture, media_type="image/png", headers=headers)


def _matches(etag: str, header: str) -> bool:
    """Compare weakly (RFC 9110, section 13.1.2)."""
    tags = {tag.strip().removeprefix("W/") for tag in header.split(",")}
    return etag in tags or "*" in tags
