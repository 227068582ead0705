"""Points in and predictions out, as JSON and as npy: the same for HTTP and zenoh."""

import io
from typing import Annotated, Any, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import (
    BaseModel,
    ConfigDict,
    Field,
    PlainValidator,
    ValidationError,
    WithJsonSchema,
)
from pydantic_core import from_json, to_json

from gpom_core.errors import InvalidQueryError
from gpom_core.snapshot import Prediction, Snapshot
from service import piecewise
from service.errors import PayloadTooLargeError, UnsupportedMediaError
from service.npy import read_header

JSON = "application/json"
NPY = "application/x-npy"

_HEADER_BYTES_MAX = 10_000

Fusion = Literal["bcm", "poe", "rbcm"]
Method = Literal["exact", "field"]


def _to_points(value: Any) -> NDArray[np.float64]:
    expected = "expected [[x, y], ...] of finite numbers, in m in the map frame"
    if not isinstance(value, list):
        raise ValueError(f"points is a {type(value).__name__}; {expected}")
    if not value:
        return np.empty((0, 2))
    try:
        points = np.asarray(value)
    except ValueError as error:
        raise ValueError(f"the points differ in length; {expected}") from error
    # Strings, null and huge integers give other kinds; a bool among numbers passes as 0 or 1.
    if points.dtype.kind not in "iuf":
        raise ValueError(f"the points hold something else than numbers; {expected}")
    if points.ndim != 2 or points.shape[1] != 2:
        raise ValueError(f"points has shape {points.shape}, not (N, 2); {expected}")
    return points.astype(np.float64)


Points = Annotated[
    NDArray[np.float64],
    PlainValidator(_to_points),
    WithJsonSchema(
        {
            "type": "array",
            "items": {
                "type": "array",
                "items": {"type": "number"},
                "minItems": 2,
                "maxItems": 2,
            },
            "description": "x, y of each point, m in the map frame",
            "examples": [[[0.0, 0.0], [1.5, -2.0]]],
        }
    ),
]


ABOUT_FUSION = (
    "how experts are merged: bcm, for which probabilities are calibrated; rbcm, surer than it "
    "should be; poe, as the paper prints it, to which places are certain where nobody has looked"
)


class PointsRequest(BaseModel):
    """A question about points."""

    model_config = ConfigDict(extra="forbid", arbitrary_types_allowed=True)

    points: Points
    fusion: Fusion = Field("bcm", description=ABOUT_FUSION)
    method: Method = Field(
        "exact",
        description="field interpolates where many points are asked for: a hundredth of the time, "
        "and 99 of 100 probabilities within 0.01 of the exact ones",
    )


class PointsAnswer(BaseModel):
    """What the map says about each point, in the order asked."""

    map_version: int = Field(examples=[42])
    occupancy: list[float] = Field(description="probability, 0.5 where nothing is known")
    mean: list[float] = Field(description="latent mean, -1 free to +1 occupied")
    variance: list[float] = Field(description="latent variance, the prior's where unknown")
    known: list[bool] = Field(description="whether variance is clearly below the prior's")


def read_request(
    body: bytes, media_type: str, fusion: str | None, method: str | None = None
) -> PointsRequest:
    """Decode a question.

    Args:
        body: as `media_type` says.
        media_type: `JSON` or `NPY`.
        fusion: rule named beside the body; a rule in a JSON body wins.
        method: named beside the body, in the same way.

    Raises:
        InvalidQueryError: malformed; says what was expected.
        UnsupportedMediaError: another media type.
    """
    beside = {"fusion": fusion, "method": method}
    fields: dict[str, Any] = {name: value for name, value in beside.items() if value is not None}
    try:
        if media_type == JSON:
            content = from_json(body)
            if not isinstance(content, dict):
                raise InvalidQueryError('the body is no object; expected {"points": [[x, y], ...]}')
            return PointsRequest.model_validate(fields | content)
        if media_type == NPY:
            points = read_npy(body)
            request = PointsRequest(points=[], **fields)
            return request.model_copy(update={"points": points})
    except ValidationError as error:
        raise InvalidQueryError(_explain(error)) from error
    except ValueError as error:
        raise InvalidQueryError(f"the body is no JSON: {error}") from error
    raise UnsupportedMediaError(f"{media_type or 'no media type'}; expected {JSON} or {NPY}")


def read_npy(body: bytes) -> NDArray[np.float64]:
    """Decode an npy file of (N, 2) float64 without trusting its header.

    Raises:
        InvalidQueryError: it is something else.
    """
    stream = io.BytesIO(body)
    try:
        shape, fortran, dtype = read_header(stream, _HEADER_BYTES_MAX)
    except ValueError as error:
        raise InvalidQueryError(f"the body is no npy file: {error}") from error
    if dtype.kind != "f" or dtype.itemsize != 8 or len(shape) != 2 or shape[1] != 2:
        message = f"the array is {dtype} of shape {shape}; expected float64 of shape (N, 2)"
        raise InvalidQueryError(message)
    data = memoryview(body)[stream.tell() :]
    if len(data) != 16 * shape[0]:
        message = (
            f"{len(data)} bytes follow the npy header; its shape {shape} needs {16 * shape[0]}"
        )
        raise InvalidQueryError(message)
    flat = np.frombuffer(data, dtype)
    points = flat.reshape(2, -1).T if fortran else flat.reshape(-1, 2)
    return np.ascontiguousarray(points, np.float64)


def predict(
    snapshot: Snapshot, request: PointsRequest, points_max: int, check: piecewise.Check
) -> Prediction:
    """Answer a question from a snapshot; `check` is called again and again, and may raise.

    Raises:
        InvalidQueryError: a point is not finite.
        PayloadTooLargeError: more than `points_max` points.
    """
    count = len(request.points)
    if count > points_max:
        message = f"{count} points in one query; at most {points_max} are allowed: split it"
        raise PayloadTooLargeError(message)
    return piecewise.query(snapshot, request.points, request.fusion, check, request.method)


def write_answer(prediction: Prediction, map_version: int, media_type: str) -> bytes:
    """Encode an answer as `JSON` or `NPY`; npy is (N, 4): occupancy, mean, variance, known."""
    if media_type == NPY:
        return write_npy(
            np.column_stack(
                (
                    prediction.occupancy,
                    prediction.mean,
                    prediction.variance,
                    prediction.known.astype(np.float64),
                )
            )
        )
    return to_json(
        {
            "map_version": map_version,
            "occupancy": prediction.occupancy.tolist(),
            "mean": prediction.mean.tolist(),
            "variance": prediction.variance.tolist(),
            "known": prediction.known.tolist(),
        }
    )


def write_npy(array: NDArray[Any]) -> bytes:
    """Encode one array as an npy file."""
    stream = io.BytesIO()
    np.save(stream, array, allow_pickle=False)
    return stream.getvalue()


def _explain(error: ValidationError) -> str:
    return "; ".join(
        f"{'.'.join(map(str, item['loc'])) or 'body'}: {item['msg'].removeprefix('Value error, ')}"
        for item in error.errors(include_url=False, include_input=False)
    )
