"""The web application. Nothing lives at module level: two apps in one process do not meet."""

import asyncio
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from importlib.metadata import PackageNotFoundError, version

from fastapi import FastAPI

from service.http import (
    errors,
    experts,
    grids,
    openapi,
    pages,
    queries,
    statuses,
    streams,
    tiles,
)
from service.http.bodies import Bodies, Uploads
from service.http.guard import Guard
from service.http.head import Head
from service.http.observe import Observe
from service.http.shares import Shares
from service.map_service import MapService


def create_app(service: MapService) -> FastAPI:
    """Build the application around a service, which its lifespan starts and stops."""
    settings = service.settings

    @asynccontextmanager
    async def lifespan(_: FastAPI) -> AsyncIterator[None]:
        await asyncio.to_thread(service.start)
        try:
            yield
        finally:
            await asyncio.to_thread(service.stop)

    app = FastAPI(
        title="gpom",
        version=_version(),
        lifespan=lifespan,
        docs_url=None,  # they load scripts from elsewhere; service.http.pages has its own
        redoc_url=None,
        responses=errors.RESPONSES,
    )
    app.state.service = service
    app.add_middleware(Head)
    app.state.uploads = Uploads()
    app.add_middleware(
        Bodies,
        bytes_max=settings.http.body_bytes_max,
        timeout_s=settings.http.body_timeout_s,
        uploads=app.state.uploads,
    )
    app.add_middleware(Shares, http=settings.http)
    app.add_middleware(Observe, metrics=service.metrics)
    app.add_middleware(Guard, access=settings.access)
    errors.install(app)
    routers = [
        module.router for module in (queries, grids, tiles, experts, statuses, streams, pages)
    ]
    for router in routers:
        app.include_router(router)
    app.state.routes = [route for router in routers for route in router.routes]
    access = settings.access
    asks = any((access.read_tokens, access.write_tokens, access.admin_tokens))
    openapi.describe(app, tokens=asks)
    return app


def _version() -> str:
    try:
        return version("gpom")
    except PackageNotFoundError:
        return "0"
