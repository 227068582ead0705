"""The pages for people, GET / and GET /docs, and their files: ours, Leaflet's and Swagger UI's."""

import hashlib
import json
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cache
from importlib.resources import files
from typing import Annotated

from fastapi import APIRouter, Header, Response
from starlette.exceptions import HTTPException

from service import palettes
from service.http.context import Service

router = APIRouter(include_in_schema=False)

_POLICY = (
    "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self' blob: data:; "
    "connect-src 'self'; manifest-src 'self'; base-uri 'none'; form-action 'none'; "
    "frame-ancestors 'self'"
)
_HEADERS = {
    "Content-Security-Policy": _POLICY,
    "X-Content-Type-Options": "nosniff",
    "Referrer-Policy": "no-referrer",
    "Cache-Control": "no-cache",
}
_MEDIA = {
    "html": "text/html; charset=utf-8",
    "css": "text/css; charset=utf-8",
    "js": "text/javascript; charset=utf-8",
    "json": "application/json",
    "svg": "image/svg+xml",
}
# What comes in packages, so that nothing is loaded from elsewhere: sites are often offline.
_PACKAGED = (
    ("xstatic.pkg.leaflet", "data", ("leaflet.js", "leaflet.css")),
    ("fastapi_offline", "static", ("swagger-ui-bundle.js", "swagger-ui.css")),
)


@dataclass(frozen=True, slots=True)
class _File:
    content: bytes
    media: str
    etag: str


@router.get("/", response_class=Response)
async def page(if_none_match: Annotated[str | None, Header()] = None) -> Response:
    """Show the live map; everything it needs comes from this service."""
    return _send("index.html", if_none_match)


@router.get("/docs", response_class=Response)
async def docs(if_none_match: Annotated[str | None, Header()] = None) -> Response:
    """Show what can be asked for, to read and to try."""
    return _send("docs.html", if_none_match)


@router.get("/page/palettes.json", response_class=Response)
async def colors(
    service: Service, if_none_match: Annotated[str | None, Header()] = None
) -> Response:
    """Tell what the colours of tiles mean."""
    snapshot = service.state.snapshot
    most = snapshot.known_variance_ratio * snapshot.prior_variance
    content = json.dumps({**_palettes(), "variance_max": most}).encode()
    return _answer(_file("palettes.json", content), if_none_match)


@router.get("/page/{name}", response_class=Response)
async def page_file(name: str, if_none_match: Annotated[str | None, Header()] = None) -> Response:
    """Give one of the page's files."""
    return _send(name, if_none_match)


def _send(name: str, if_none_match: str | None) -> Response:
    file = _files().get(name)
    if file is None:
        raise HTTPException(404, "the page has no such file")
    return _answer(file, if_none_match)


def _answer(file: _File, if_none_match: str | None) -> Response:
    headers = {**_HEADERS, "ETag": file.etag}
    if if_none_match == file.etag:
        return Response(status_code=304, headers=headers)
    return Response(file.content, media_type=file.media, headers=headers)


@cache
def _files() -> dict[str, _File]:
    """Everything that is served, by name; nothing else on this disk can be asked for."""
    return {name: _file(name, content) for name, content in _contents()}


def _contents() -> Iterator[tuple[str, bytes]]:
    for item in files("service").joinpath("page").iterdir():
        if item.is_file() and item.name.rpartition(".")[2] in _MEDIA:
            yield item.name, item.read_bytes()
    for package, folder, names in _PACKAGED:
        for name in names:
            yield name, files(package).joinpath(folder, name).read_bytes()


def _palettes() -> dict[str, dict[str, list[str]]]:
    themes: dict[str, dict[str, list[str]]] = {}
    for (layer, theme), palette in palettes.TILES.items():
        themes.setdefault(theme, {})[layer] = palettes.css(palette)
    return themes


def _file(name: str, content: bytes) -> _File:
    etag = '"' + hashlib.sha256(content).hexdigest()[:16] + '"'
    return _File(content, _MEDIA[name.rpartition(".")[2]], etag)
