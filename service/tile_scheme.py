"""The squares that a slippy map is cut into: 256 x 256 pixels, 2^zoom pixels to the metre.

Zoom 0 is one pixel to the metre, as in Leaflet's `CRS.Simple` with y as latitude and x as
longitude. Column x begins at x * size to the east of the origin; row y ends at -y * size, since
rows count downwards from the origin: tile (0, -1) is the one north-east of it.
"""

from dataclasses import dataclass
from math import floor

from gpom_core.member import Bounds

TILE_PIXELS = 256
ZOOM_MIN, ZOOM_MAX = -4, 10
INDEX_MAX = 1 << 30


@dataclass(frozen=True, slots=True)
class TileAddress:
    """Which tile: zoom, column, row."""

    zoom: int
    x: int
    y: int

    @property
    def pixel_m(self) -> float:
        """Edge of a pixel."""
        return 2.0**-self.zoom

    @property
    def bounds(self) -> Bounds:
        """xmin, ymin, xmax, ymax in m."""
        size_m = TILE_PIXELS * self.pixel_m
        return self.x * size_m, -(self.y + 1) * size_m, (self.x + 1) * size_m, -self.y * size_m

    def squares(self, edge_m: float) -> tuple[range, range]:
        """Columns and rows, from the south, of the squares of a coarser lattice that it touches."""
        xmin, ymin, xmax, ymax = self.bounds
        return _touched(xmin, xmax, edge_m), _touched(ymin, ymax, edge_m)


def _touched(low: float, high: float, edge_m: float) -> range:
    # What ends where a square begins does not touch it.
    return range(floor(low / edge_m), -floor(-high / edge_m))
