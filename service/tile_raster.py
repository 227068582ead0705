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

# Finer than this the function is smooth: its precision and information are interpolated, which
# for a length scale of 0.2 m moves probabilities by less than a shade of the picture.
_LATTICE_M = 2.0**-4
# Coarser than this a pixel would step over walls: it shows the most occupied of several samples.
_SAMPLE_M = 2.0**-3
_SAMPLES_MAX = 4  # along each edge of a pixel
_FADE = 0.1  # of the prior variance, on both sides of where the known ends
_SHADES = 64  # enough for the eye, few enough to compress well


@dataclass(frozen=True, slots=True)
class _Samples:
    """Values of the pixels, (256, 256), first row in the north."""

    occupancy: NDArray[np.float64]
    variance: NDArray[np.float64]


def draw(snapshot: Snapshot, tile: TileAddress, layer: TileLayer, theme: Theme) -> bytes:
    """Draw a tile as PNG; what is not known is transparent."""
    samples = _coarse(snapshot, tile) if tile.pixel_m > _LATTICE_M else _fine(snapshot, tile)
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


def _coarse(snapshot: Snapshot, tile: TileAddress) -> _Samples:
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


def _fine(snapshot: Snapshot, tile: TileAddress) -> _Samples:
    """Interpolate between the nodes of a lattice that all tiles share, so that they join."""
    xmin, ymin, xmax, ymax = tile.bounds
    low_x, low_y = np.floor(xmin / _LATTICE_M), np.floor(ymin / _LATTICE_M)
    high_x, high_y = np.ceil(xmax / _LATTICE_M), np.ceil(ymax / _LATTICE_M)
    # Nodes are the centres of the cells of this raster.
    west, south = (low_x - 0.5) * _LATTICE_M, (low_y - 0.5) * _LATTICE_M
    east, north = (high_x + 0.5) * _LATTICE_M, (high_y + 0.5) * _LATTICE_M
    nodes = snapshot.grid((west, south, east, north), _LATTICE_M)
    offsets = (np.arange(TILE_PIXELS) + 0.5) * tile.pixel_m
    across = _weights((xmin + offsets) / _LATTICE_M - low_x, nodes.mean.shape[1])
    up = _weights((ymin + offsets) / _LATTICE_M - low_y, nodes.mean.shape[0])
    precision = up @ (1.0 / nodes.variance) @ across.T
    information = up @ (nodes.mean / nodes.variance) @ across.T
    mean, variance = information / precision, 1.0 / precision
    occupancy = snapshot.calibration.probability(mean, variance)
    return _Samples(occupancy[::-1], variance[::-1])


def _weights(at: NDArray[np.float64], nodes: int) -> NDArray[np.float64]:
    """Linear interpolation as a matrix (pixels, nodes)."""
    left = np.clip(np.floor(at).astype(np.int64), 0, nodes - 2)
    share = at - left
    matrix = np.zeros((len(at), nodes))
    rows = np.arange(len(at))
    matrix[rows, left] = 1.0 - share
    matrix[rows, left + 1] = share
    return matrix


def _png(
    shade: NDArray[np.float64], alpha: NDArray[np.float64], palette: palettes.Palette
) -> bytes:
    steps = np.rint(np.clip(shade, 0.0, 1.0) * (_SHADES - 1)).astype(np.intp)
    pixels = np.empty((*shade.shape, 4), np.uint8)
    pixels[..., :3] = palettes.table(palette, _SHADES)[steps]
    pixels[..., 3] = np.rint(alpha * 255.0)
    pixels[pixels[..., 3] == 0] = 0  # what nobody sees compresses best when it is all the same
    return _encode(Image.fromarray(pixels))


def _encode(image: Image.Image) -> bytes:
    stream = io.BytesIO()
    image.save(stream, "PNG", compress_level=1)
    return stream.getvalue()
