"""A raster as Nav2's and ROS 1's `map_server` load it: a zip of a PGM picture and its YAML."""

import io
import zipfile

import numpy as np
import yaml

from gpom_core.member import Bounds
from gpom_core.snapshot import Prediction

# map_server's own convention: black occupied, white free, 205 just misses the free threshold.
_OCCUPIED, _FREE, _UNKNOWN = 0, 254, 205
_OCCUPIED_THRESHOLD, _FREE_THRESHOLD = 0.65, 0.196


def archive(grid: Prediction, bbox: Bounds, resolution_m: float) -> bytes:
    """Zip ``map.pgm`` and ``map.yaml``; a cell is unknown unless it is known and decided."""
    pixels = np.full_like(grid.occupancy, _UNKNOWN, np.uint8)
    pixels[grid.known & (grid.occupancy >= _OCCUPIED_THRESHOLD)] = _OCCUPIED
    pixels[grid.known & (grid.occupancy < _FREE_THRESHOLD)] = _FREE
    rows, columns = grid.occupancy.shape
    header = f"P5\n{columns} {rows}\n255\n".encode()
    description = {
        "image": "map.pgm",
        "mode": "trinary",
        "resolution": resolution_m,
        "origin": [bbox[0], bbox[1], 0.0],
        "negate": 0,
        "occupied_thresh": _OCCUPIED_THRESHOLD,
        "free_thresh": _FREE_THRESHOLD,
    }
    stream = io.BytesIO()
    with zipfile.ZipFile(stream, "w", zipfile.ZIP_DEFLATED) as files:
        files.writestr("map.pgm", header + pixels[::-1].tobytes())  # its first row is the top
        files.writestr("map.yaml", yaml.safe_dump(description, sort_keys=False))
    return stream.getvalue()
