"""A raster as Nav2's and ROS 1's `map_server` load it: pictures and their YAML in a zip.

`map.yaml` is occupancy, `variance.yaml` how unsure it is. map_server reads a picture in one of
three modes; each keeps the unknown apart from the free (nav2_map_server/src/map_io.cpp):

trinary  occupied, free or unknown; what every planner expects
scale    probability in percent, the unknown by transparency
raw      the cells of an OccupancyGrid, 0 to 100, beyond that unknown
"""

import io
import zipfile
from typing import Any, Literal

import numpy as np
import yaml
from numpy.typing import NDArray
from PIL import Image

from gpom_core.member import Bounds
from gpom_core.snapshot import Prediction

Mode = Literal["trinary", "scale", "raw"]

# map_server's own convention: black occupied, white free, 205 just misses the free threshold.
_OCCUPIED, _FREE, _UNKNOWN = 0, 254, 205
_OCCUPIED_THRESHOLD, _FREE_THRESHOLD = 0.65, 0.196
_RAW_UNKNOWN = 255


def archive(
    grid: Prediction,
    bbox: Bounds,
    resolution_m: float,
    *,
    mode: Mode = "trinary",
    prior_variance: float = 1.0,
) -> bytes:
    """Zip occupancy and variance, each as a picture with its YAML.

    Args:
        grid: cells (rows, columns), row 0 at ymin.
        bbox: whose lower left corner is the origin.
        resolution_m: edge of a cell.
        mode: how map_server is to read occupancy; of `trinary`, a cell is unknown unless it is
            known and decided.
        prior_variance: reads as 100 in the picture of the variance, which is always `raw`.
    """
    percent = np.rint(np.clip(grid.variance / prior_variance, 0.0, 1.0) * 100.0)
    stream = io.BytesIO()
    with zipfile.ZipFile(stream, "w", zipfile.ZIP_DEFLATED) as files:
        for name, form, picture in (
            ("map", mode, _PICTURES[mode](grid)),
            ("variance", "raw", percent.astype(np.uint8)),
        ):
            image = f"{name}.pgm" if picture.ndim == 2 else f"{name}.png"
            files.writestr(image, _encode(picture[::-1]))  # its first row is the top
            description = _describe(image, form, bbox, resolution_m)
            files.writestr(f"{name}.yaml", yaml.safe_dump(description, sort_keys=False))
    return stream.getvalue()


def _trinary(grid: Prediction) -> NDArray[np.uint8]:
    pixels = np.full_like(grid.occupancy, _UNKNOWN, np.uint8)
    pixels[grid.known & (grid.occupancy >= _OCCUPIED_THRESHOLD)] = _OCCUPIED
    pixels[grid.known & (grid.occupancy < _FREE_THRESHOLD)] = _FREE
    return pixels


def _scale(grid: Prediction) -> NDArray[np.uint8]:
    gray = np.rint(255.0 * (1.0 - grid.occupancy))
    return np.stack((gray, np.where(grid.known, 255.0, 0.0)), axis=-1).astype(np.uint8)


def _raw(grid: Prediction) -> NDArray[np.uint8]:
    return np.where(grid.known, np.rint(100.0 * grid.occupancy), _RAW_UNKNOWN).astype(np.uint8)


_PICTURES = {"trinary": _trinary, "scale": _scale, "raw": _raw}


def _encode(pixels: NDArray[np.uint8]) -> bytes:
    if pixels.ndim == 2:
        rows, columns = pixels.shape
        return f"P5\n{columns} {rows}\n255\n".encode() + pixels.tobytes()
    stream = io.BytesIO()
    Image.fromarray(np.ascontiguousarray(pixels)).save(stream, "PNG")
    return stream.getvalue()


def _describe(image: str, mode: str, bbox: Bounds, resolution_m: float) -> dict[str, Any]:
    # Between 0 and 1 the scale is the probability itself.
    scale = mode == "scale"
    return {
        "image": image,
        "mode": mode,
        "resolution": resolution_m,
        "origin": [bbox[0], bbox[1], 0.0],
        "negate": 0,
        "occupied_thresh": 1.0 if scale else _OCCUPIED_THRESHOLD,
        "free_thresh": 0.0 if scale else _FREE_THRESHOLD,
    }
