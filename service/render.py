"""Rasters as pictures: one byte a cell, a palette for each layer, north up."""

import io
from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from gpom_core.snapshot import Prediction

Layer = Literal["occupancy", "mean", "variance", "known"]
Color = tuple[int, int, int]

UNKNOWN_COLOR: Color = (176, 190, 205)  # bluish, so that it is no shade of occupancy
_SHADES = 255  # indices 0..254 are values, index 255 is unknown
_UNKNOWN = 255

_GRAY: tuple[Color, ...] = ((255, 255, 255), (0, 0, 0))
_HEAT: tuple[Color, ...] = (
    (12, 8, 38),
    (87, 16, 110),
    (188, 55, 84),
    (249, 142, 9),
    (252, 255, 164),
)
_DIVERGING: tuple[Color, ...] = ((33, 102, 172), (247, 247, 247), (178, 24, 43))


@dataclass(frozen=True, slots=True)
class _Look:
    colors: tuple[Color, ...]
    shade: Callable[[Prediction, float], NDArray[np.float64]]
    marks_unknown: bool


_LOOKS: dict[Layer, _Look] = {
    "occupancy": _Look(_GRAY, lambda grid, _: grid.occupancy, True),
    "mean": _Look(_DIVERGING, lambda grid, _: (grid.mean + 1.0) / 2.0, True),
    "variance": _Look(_HEAT, lambda grid, prior: grid.variance / prior, False),
    "known": _Look(_GRAY[::-1], lambda grid, _: grid.known.astype(np.float64), False),
}


def png(grid: Prediction, layer: Layer, prior_variance: float) -> bytes:
    """Draw one layer, ymax on top.

    Occupancy goes from white (free) to black, mean from blue to red, variance from dark (sure) to
    bright (the prior), known is white; what occupancy and mean do not know has a colour of its own.
    """
    look = _LOOKS[layer]
    shades = np.clip(look.shade(grid, prior_variance), 0.0, 1.0) * (_SHADES - 1)
    indices = np.rint(shades).astype(np.uint8)
    if look.marks_unknown:
        indices[~grid.known] = _UNKNOWN
    image = Image.fromarray(np.ascontiguousarray(indices[::-1]))
    image.putpalette(_palette(look.colors))  # turns gray values into indices
    stream = io.BytesIO()
    image.save(stream, "PNG", compress_level=4)
    return stream.getvalue()


def _palette(colors: tuple[Color, ...]) -> bytes:
    at = np.linspace(0.0, 1.0, len(colors))
    shades = np.linspace(0.0, 1.0, _SHADES)
    channels = [np.interp(shades, at, channel) for channel in zip(*colors, strict=True)]
    table = np.vstack((np.column_stack(channels), UNKNOWN_COLOR))
    return bytes(np.rint(table).astype(np.uint8))
