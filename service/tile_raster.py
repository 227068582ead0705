"""The picture of one tile, from the map function itself at the tile's own resolution."""

import io
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from gpom_core.snapshot import Snapshot
from service import palettes
from service.tile_scheme import TILE_PIXELS, TileAddress

TileLayer = Literal["occupancy", "variance", "state"]
Theme = Literal["light", "dark"]

# Coarser than this a pixel would step over walls: it shows the most occupied of several samples.
_SAMPLE_M = 2.0**-3
_DRAFT_PIXELS = 4  # edge of what a draft has for a pixel
_SAMPLES_MAX = 4  # along each edge of a pixel
_FADE = 0.1  # of the prior variance, on both sides of where the known ends
_SHADES = 64  # enough for the eye, few enough to compress well


@dataclass(frozen=True, slots=True)
class _Samples:
    """Values of the pixels, (256, 256), first row in the north."""

    occupancy: NDArray[np.float64]
    variance: NDArray[np.float64]


def draw(
    snapshot: Snapshot,
    tile: TileAddress,
    layer: TileLayer,
    theme: Theme,
    *,
    draft: bool = False,
) -> bytes:
    """Draw a tile as PNG; what is not known is transparent. A draft is coarse, and soon there."""
    if draft:
        grid = snapshot.grid(tile.bounds, tile.pixel_m * _DRAFT_PIXELS, method="field")
        samples = _Samples(grid.occupancy[::-1], grid.variance[::-1])
    else:
        samples = _sample(snapshot, tile)
    ratio = samples.variance / snapshot.prior_variance
    threshold = snapshot.known_variance_ratio
    known = np.clip((threshold + _FADE - ratio) / (2.0 * _FADE), 0.0, 1.0)
    shade = samples.occupancy
    if layer == "variance":
        shade = ratio / threshold
    elif layer == "state":
        shade, known = np.rint(shade), (ratio < threshold).astype(np.float64)
    return _png(shade, known, palettes.TILES[layer, theme])


def empty() -> bytes:
    """Draw a tile of which nothing is known."""
    return _encode(Image.new("LA", (TILE_PIXELS, TILE_PIXELS)))


def _sample(snapshot: Snapshot, tile: TileAddress) -> _Samples:
    """Evaluate at pixel centres, or at several places in each pixel."""
    n = int(np.clip(np.ceil(tile.pixel_m / _SAMPLE_M), 1, _SAMPLES_MAX))
    grid = snapshot.grid(tile.bounds, tile.pixel_m / n, method="field")
    if n == 1:
        return _Samples(grid.occupancy[::-1], grid.variance[::-1])
    known = grid.known
    # Unknown samples do not outvote known ones of the same pixel, be they free.
    occupancy = _by_pixel(np.where(known, grid.occupancy, -1.0), n).max(axis=-1)
    occupancy[occupancy < 0.0] = 0.5
    variance = _by_pixel(grid.variance, n).min(axis=-1)
    return _Samples(occupancy[::-1], variance[::-1])


def _by_pixel(values: NDArray[np.float64], n: int) -> NDArray[np.float64]:
    rows, columns = values.shape[0] // n, values.shape[1] // n
    return values.reshape(rows, n, columns, n).swapaxes(1, 2).reshape(rows, columns, n * n)


def _png(
    shade: NDArray[np.float64], alpha: NDArray[np.float64], palette: palettes.Palette
) -> bytes:
    steps = np.rint(np.clip(shade, 0.0, 1.0) * (_SHADES - 1)).astype(np.intp)
    pixels = np.empty((*shade.shape, 4), np.uint8)
    pixels[..., :3] = palettes.table(palette, _SHADES)[steps]
    pixels[..., 3] = np.rint(alpha * 255.0)
    pixels[pixels[..., 3] == 0] = 0  # what nobody sees compresses best when it is all the same
    image = Image.fromarray(pixels)
    if image.width != TILE_PIXELS:
        image = image.resize((TILE_PIXELS, TILE_PIXELS), Image.Resampling.BILINEAR)
    return _encode(image)


def _encode(image: Image.Image) -> bytes:
    stream = io.BytesIO()
    image.save(stream, "PNG", compress_level=1)
    return stream.getvalue()
