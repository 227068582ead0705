"""Colours of the live map's layers: lightness tells the value, so that every eye can read them.

Each palette is monotone in lightness (state: two colours of Okabe and Ito's set), and looks right
on the page's background of the same theme, which is the colour of the unknown.
"""

from functools import cache

import numpy as np
from numpy.typing import NDArray

Color = tuple[int, int, int]
Palette = tuple[Color, ...]

_INK: Palette = ((253, 253, 252), (196, 209, 221), (108, 138, 171), (38, 66, 112), (10, 18, 44))
_GLOW: Palette = ((30, 42, 56), (66, 76, 88), (137, 119, 92), (226, 168, 84), (255, 236, 190))
_CIVIDIS: Palette = (
    (0, 34, 78),
    (33, 60, 109),
    (85, 91, 108),
    (123, 122, 119),
    (165, 156, 116),
    (211, 193, 100),
    (253, 231, 55),
)

TILES: dict[tuple[str, str], Palette] = {
    ("occupancy", "light"): _INK,
    ("occupancy", "dark"): _GLOW,
    ("variance", "light"): _CIVIDIS,
    ("variance", "dark"): _CIVIDIS,
    ("state", "light"): ((166, 214, 240), (213, 94, 0)),
    ("state", "dark"): ((26, 82, 118), (240, 140, 60)),
}
"""For each layer and theme, from 0 to 1."""


@cache
def table(palette: Palette, shades: int) -> NDArray[np.uint8]:
    """Interpolate a palette to so many shades, (shades, 3)."""
    at = np.linspace(0.0, 1.0, len(palette))
    shade = np.linspace(0.0, 1.0, shades)
    channels = [np.interp(shade, at, channel) for channel in zip(*palette, strict=True)]
    colors = np.rint(np.column_stack(channels)).astype(np.uint8)
    colors.flags.writeable = False
    return np.asarray(colors)


def css(palette: Palette) -> list[str]:
    """Give its colours as a web page writes them."""
    return ["#{:02x}{:02x}{:02x}".format(*color) for color in palette]
