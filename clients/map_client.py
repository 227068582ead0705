"""The map's HTTP interface with numpy in and out, blocking and asynchronous."""

from collections.abc import Sequence
from types import TracebackType
from typing import Any, Self, TypeVar

import httpx
import numpy as np
from numpy.typing import ArrayLike, NDArray

from clients import calls
from clients.answers import MapPrediction, MapStatus, PointPrediction
from clients.calls import Call
from clients.keys import DEFAULT_URL
from gpom_core.errors import ConfigurationError

DEFAULT_TIMEOUT_S = 30.0

T = TypeVar("T")


class MapClient:
    """Asks a map service; use it as a context manager. May be shared by threads.

    Every method raises `MapServiceError` or one of its kinds: `MapRequestError` when the question
    is refused, `MapUnreachableError` and `MapTimeoutError` when no answer comes,
    `MapUnavailableError` when the service cannot answer now. What cannot even be asked is an
    `InvalidQueryError`.

    Args:
        url: of the service.
        timeout_s: for one answer.
        transport: other than the network, for tests.

    Raises:
        ConfigurationError: the address is malformed.
    """

    def __init__(
        self,
        url: str = DEFAULT_URL,
        *,
        timeout_s: float = DEFAULT_TIMEOUT_S,
        transport: httpx.BaseTransport | None = None,
    ) -> None:
        self.url = check_url(url)
        self._http = httpx.Client(base_url=self.url, timeout=timeout_s, transport=transport)

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self.close()

    def close(self) -> None:
        """Let go of the connections."""
        self._http.close()

    def query(self, points: ArrayLike, fusion: str = "bcm", method: str = "exact") -> MapPrediction:
        """Ask about points (N, 2), x and y in m.

        Args:
            fusion: bcm, rbcm or poe.
            method: exact, or field, which interpolates where many points are asked for.
        """
        return self._run(calls.query(points, fusion, method))

    def query_point(self, x_m: float, y_m: float, fusion: str = "bcm") -> PointPrediction:
        """Ask about one point."""
        return self._run(calls.query_point(x_m, y_m, fusion))

    def grid(
        self, bbox: Sequence[float], resolution_m: float, layer: str = "occupancy"
    ) -> NDArray[np.float64]:
        """Ask for a raster of xmin, ymin, xmax, ymax in m: (rows, cols), row 0 at ymin."""
        return self._run(calls.grid(bbox, resolution_m, layer))

    def raster(
        self,
        bbox: Sequence[float],
        resolution_m: float,
        layer: str = "occupancy",
        file_format: str = "png",
    ) -> bytes:
        """Ask for a raster as the content of a file: png (ymax on top), npy or nav2."""
        return self._run(calls.raster(bbox, resolution_m, layer, file_format))

    def status(self) -> MapStatus:
        """Ask how far the map is."""
        return self._run(calls.status())

    def experts(self) -> list[dict[str, Any]]:
        """Ask for all clusters: line, observations, hyperparameters, dirty or not."""
        return self._run(calls.experts())

    def flush(self, timeout_s: float = 60.0) -> MapStatus:
        """Wait until all scans received so far are in the map."""
        return self._run(calls.flush(timeout_s))

    def ready(self) -> bool:
        """Ask whether the service takes scans and questions; raises when nothing answers."""
        return self._run(calls.ready())

    def _run(self, call: Call[T]) -> T:
        try:
            response = self._http.send(call.build(self._http))
        except httpx.RequestError as error:
            raise calls.to_unreachable(error, self.url) from error
        return call.finish(response)


class AsyncMapClient:
    """`MapClient` for asyncio: the same methods, to be awaited."""

    def __init__(
        self,
        url: str = DEFAULT_URL,
        *,
        timeout_s: float = DEFAULT_TIMEOUT_S,
        transport: httpx.AsyncBaseTransport | None = None,
    ) -> None:
        self.url = check_url(url)
        self._http = httpx.AsyncClient(base_url=self.url, timeout=timeout_s, transport=transport)

    async def __aenter__(self) -> Self:
        return self

    async def __aexit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        await self.close()

    async def close(self) -> None:
        """Let go of the connections."""
        await self._http.aclose()

    async def query(
        self, points: ArrayLike, fusion: str = "bcm", method: str = "exact"
    ) -> MapPrediction:
        """See `MapClient.query`."""
        return await self._run(calls.query(points, fusion, method))

    async def query_point(self, x_m: float, y_m: float, fusion: str = "bcm") -> PointPrediction:
        """See `MapClient.query_point`."""
        return await self._run(calls.query_point(x_m, y_m, fusion))

    async def grid(
        self, bbox: Sequence[float], resolution_m: float, layer: str = "occupancy"
    ) -> NDArray[np.float64]:
        """See `MapClient.grid`."""
        return await self._run(calls.grid(bbox, resolution_m, layer))

    async def raster(
        self,
        bbox: Sequence[float],
        resolution_m: float,
        layer: str = "occupancy",
        file_format: str = "png",
    ) -> bytes:
        """See `MapClient.raster`."""
        return await self._run(calls.raster(bbox, resolution_m, layer, file_format))

    async def status(self) -> MapStatus:
        """See `MapClient.status`."""
        return await self._run(calls.status())

    async def experts(self) -> list[dict[str, Any]]:
        """See `MapClient.experts`."""
        return await self._run(calls.experts())

    async def flush(self, timeout_s: float = 60.0) -> MapStatus:
        """See `MapClient.flush`."""
        return await self._run(calls.flush(timeout_s))

    async def ready(self) -> bool:
        """See `MapClient.ready`."""
        return await self._run(calls.ready())

    async def _run(self, call: Call[T]) -> T:
        try:
            response = await self._http.send(call.build(self._http))
        except httpx.RequestError as error:
            raise calls.to_unreachable(error, self.url) from error
        return call.finish(response)


def check_url(url: str) -> str:
    """Give the address without a slash at its end.

    Raises:
        ConfigurationError: it is no http address.
    """
    try:
        parsed = httpx.URL(url)
    except httpx.InvalidURL as error:
        message = f"the address {url!r} is malformed: {error}; expected one such as {DEFAULT_URL}"
        raise ConfigurationError(message) from error
    if parsed.scheme not in {"http", "https"} or not parsed.host:
        message = f"the address {url!r} is no http address; expected one such as {DEFAULT_URL}"
        raise ConfigurationError(message)
    return url.rstrip("/")
