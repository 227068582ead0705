"""A blocking client of an application in this process, without a network."""

import asyncio
import threading
from contextlib import AbstractContextManager
from typing import Self

import httpx
from fastapi import FastAPI


class WebClient(AbstractContextManager):
    """Runs the application, lifespan included, in an event loop of its own thread."""

    def __init__(self, app: FastAPI) -> None:
        self.app = app
        self._loop = asyncio.new_event_loop()
        self._thread = threading.Thread(target=self._loop.run_forever)
        transport = httpx.ASGITransport(app, raise_app_exceptions=False)
        self._http = httpx.AsyncClient(transport=transport, base_url="http://test", timeout=60.0)
        self._lifespan = app.router.lifespan_context(app)

    def __enter__(self) -> Self:
        self._thread.start()
        self._run(self._lifespan.__aenter__())
        return self

    def __exit__(self, *_) -> None:
        try:
            self._run(self._http.aclose())
            self._run(self._lifespan.__aexit__(None, None, None))
        finally:
            self._loop.call_soon_threadsafe(self._loop.stop)
            self._thread.join()
            self._loop.close()

    def get(self, path: str, **options) -> httpx.Response:
        return self.request("GET", path, **options)

    def post(self, path: str, **options) -> httpx.Response:
        return self.request("POST", path, **options)

    def request(self, method: str, path: str, **options) -> httpx.Response:
        return self._run(self._http.request(method, path, **options))

    def _run(self, coroutine):
        return asyncio.run_coroutine_threadsafe(coroutine, self._loop).result(90.0)
