"""The map's HTTP interface as values: what to send, and how to read the answer.

The one core of the blocking and the asynchronous client, which only carry these to and fro.
"""

import io
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Generic, TypeVar

import httpx
import numpy as np
from numpy.typing import ArrayLike, NDArray

from clients.answers import MapPrediction, MapStatus, PointPrediction, to_status
from clients.errors import (
    MapProtocolError,
    MapRequestError,
    MapServiceError,
    MapTimeoutError,
    MapUnavailableError,
    MapUnreachableError,
)
from gpom_core.errors import InvalidQueryError

NPY = "application/x-npy"
VERSION_HEADER = "X-Gpom-Map-Version"
# The service needs time to notice its own timeout and answer.
FLUSH_GRACE_S = 15.0

T = TypeVar("T")


@dataclass(frozen=True, slots=True)
class Call(Generic[T]):
    """One request and the reading of its answer.

    Attributes:
        method: of HTTP.
        path: below the service's address.
        read: makes the result of a good answer.
        accepted: statuses besides 2xx that `read` understands.
        timeout_s: instead of the client's own.
    """

    method: str
    path: str
    read: Callable[[httpx.Response], T]
    params: Mapping[str, str] = field(default_factory=dict)
    headers: Mapping[str, str] = field(default_factory=dict)
    content: bytes | None = None
    json: Any = None
    accepted: Sequence[int] = ()
    timeout_s: float | None = None

    def build(self, client: httpx.Client | httpx.AsyncClient) -> httpx.Request:
        """Make the request that `client` sends."""
        return client.build_request(
            self.method,
            self.path,
            params=dict(self.params),
            headers=dict(self.headers),
            content=self.content,
            json=self.json,
            timeout=client.timeout if self.timeout_s is None else self.timeout_s,
        )

    def finish(self, response: httpx.Response) -> T:
        """Read an answer.

        Raises:
            MapServiceError: it is a refusal, or not what the interface promises.
        """
        if not (response.is_success or response.status_code in self.accepted):
            raise to_error(response)
        try:
            return self.read(response)
        except (KeyError, TypeError, ValueError, EOFError) as error:
            message = (
                f"{self.method} {response.request.url} answered what is not understood "
                f"({type(error).__name__}: {error}). Is it a gpom map service of this version?"
            )
            raise MapProtocolError(
                response.status_code, "the answer is malformed", message
            ) from error


def query(points: ArrayLike, fusion: str, method: str = "exact") -> Call[MapPrediction]:
    """Ask about points (N, 2) in m; raises InvalidQueryError when they are of another shape."""
    try:
        array = np.ascontiguousarray(points, dtype=np.float64)
    except (TypeError, ValueError) as error:
        message = f"points cannot be read as numbers: {error}; expected shape (N, 2), in m"
        raise InvalidQueryError(message) from error
    if array.ndim != 2 or array.shape[1] != 2:
        message = f"points have shape {array.shape}; expected (N, 2), x and y in m"
        raise InvalidQueryError(message)
    buffer = io.BytesIO()
    np.save(buffer, array, allow_pickle=False)
    return Call(
        "POST",
        "/v1/query",
        lambda response: _read_prediction(response, len(array)),
        params={"fusion": fusion} | ({} if method == "exact" else {"method": method}),
        headers={"Content-Type": NPY, "Accept": NPY},
        content=buffer.getvalue(),
    )


def query_point(x_m: float, y_m: float, fusion: str) -> Call[PointPrediction]:
    """Ask about one point."""
    params = {"x": repr(float(x_m)), "y": repr(float(y_m)), "fusion": fusion}
    return Call("GET", "/v1/query", _read_point, params=params)


def grid(bbox: Sequence[float], resolution_m: float, layer: str) -> Call[NDArray[np.float64]]:
    """Ask for a raster as numbers."""
    params = _grid_params(bbox, resolution_m, layer, "npy")
    return Call("GET", "/v1/grid", _read_grid, params=params, headers={"Accept": NPY})


def raster(bbox: Sequence[float], resolution_m: float, layer: str, file_format: str) -> Call[bytes]:
    """Ask for a raster as a file."""
    params = _grid_params(bbox, resolution_m, layer, file_format)
    return Call("GET", "/v1/grid", lambda response: response.content, params=params)


def status() -> Call[MapStatus]:
    """Ask how far the map is."""
    return Call("GET", "/v1/status", lambda response: to_status(response.json()))


def experts() -> Call[list[dict[str, Any]]]:
    """Ask for the clusters of the map."""
    return Call("GET", "/v1/experts", _read_experts)


def flush(timeout_s: float) -> Call[MapStatus]:
    """Wait until all received so far is integrated and trained."""
    return Call(
        "POST",
        "/v1/flush",
        lambda response: to_status(response.json()),
        json={"timeout_s": timeout_s},
        timeout_s=timeout_s + FLUSH_GRACE_S,
    )


def ready() -> Call[bool]:
    """Ask whether the service takes scans and questions."""
    return Call("GET", "/readyz", lambda response: response.is_success, accepted=(503,))


def to_error(response: httpx.Response) -> MapServiceError:
    """Make the error of an answer that is no success, from its problem details (RFC 9457)."""
    status_code = response.status_code
    later = status_code >= 500 or status_code == httpx.codes.TOO_MANY_REQUESTS
    kind = MapUnavailableError if later else MapRequestError
    try:
        problem = response.json()
        title, detail = str(problem["title"]), str(problem.get("detail") or "")
    except (ValueError, TypeError, KeyError, AttributeError):
        url = response.request.url
        message = f"{response.request.method} {url} is not answered as a gpom map service does"
        return MapProtocolError(status_code, response.reason_phrase or "no problem given", message)
    return kind(status_code, title, detail)


def to_unreachable(error: httpx.RequestError, url: str) -> MapServiceError:
    """Make the error of a request that got no answer."""
    if isinstance(error, httpx.TimeoutException):
        kind = type(error).__name__.removesuffix("Timeout").lower()
        message = f"{url} took too long to {kind}; ask for less, or allow more time"
        return MapTimeoutError(None, "the map service did not answer in time", message)
    message = f"{url}: {str(error) or type(error).__name__}. Is `gpom serve` running there?"
    return MapUnreachableError(None, "the map service cannot be reached", message)


def _grid_params(
    bbox: Sequence[float], resolution_m: float, layer: str, file_format: str
) -> dict[str, str]:
    if len(bbox) != 4:
        message = f"the box has {len(bbox)} numbers; expected xmin, ymin, xmax, ymax in m"
        raise InvalidQueryError(message)
    return {
        "bbox": ",".join(repr(float(value)) for value in bbox),
        "resolution": repr(float(resolution_m)),
        "layer": layer,
        "format": file_format,
    }


def _read_npy(response: httpx.Response) -> NDArray[np.float64]:
    array = np.load(io.BytesIO(response.content), allow_pickle=False)
    return np.asarray(array, dtype=np.float64)


def _read_grid(response: httpx.Response) -> NDArray[np.float64]:
    array = _read_npy(response)
    if array.ndim != 2:
        raise ValueError(f"a grid of shape {array.shape}")
    return array


def _read_prediction(response: httpx.Response, count: int) -> MapPrediction:
    columns = _read_npy(response)
    if columns.shape != (count, 4):
        raise ValueError(f"shape {columns.shape} for {count} points")
    occupancy, mean, variance, known = np.ascontiguousarray(columns.T)
    version = int(response.headers[VERSION_HEADER])
    return MapPrediction(version, occupancy, mean, variance, known != 0.0)


def _read_point(response: httpx.Response) -> PointPrediction:
    answer = response.json()
    # The same answer as for many points, of which there is one.
    occupancy, mean, variance, known = (
        value[0] if isinstance(value := answer[name], list) else value
        for name in ("occupancy", "mean", "variance", "known")
    )
    return PointPrediction(
        int(answer["map_version"]), float(occupancy), float(mean), float(variance), bool(known)
    )


def _read_experts(response: httpx.Response) -> list[dict[str, Any]]:
    answer = response.json()
    found = answer["experts"] if isinstance(answer, dict) else answer
    return [dict(expert) for expert in found]
