"""The cells of an occupancy grid that grows with the map."""

from dataclasses import dataclass
from math import ceil, floor

import numpy as np
from numpy.typing import NDArray

from gpom_core.member import Bounds
from gpom_core.snapshot import Prediction

UNKNOWN = -1
GROWTH_CELLS = 64
"""The grid grows by blocks of so many cells, so that it does not with every scan."""

_PER_CENT = 100

Cells = NDArray[np.int8]


@dataclass(frozen=True, slots=True)
class Patch:
    """A rectangle of cells of the endless lattice of the map: cell 0, 0 begins at the origin.

    Attributes:
        column: of the first cell.
        row: likewise.
        columns: in it.
        rows: in it.
    """

    column: int
    row: int
    columns: int
    rows: int

    def bounds(self, resolution_m: float) -> Bounds:
        """Give xmin, ymin, xmax, ymax."""
        return (
            self.column * resolution_m,
            self.row * resolution_m,
            (self.column + self.columns) * resolution_m,
            (self.row + self.rows) * resolution_m,
        )

    @property
    def cells(self) -> int:
        """How many it has."""
        return self.rows * self.columns

    def contains(self, other: "Patch") -> bool:
        """Tell whether all cells of another are in this one."""
        return self.joined(other) == self

    def joined(self, other: "Patch") -> "Patch":
        """Give the smallest one around both."""
        column, row = min(self.column, other.column), min(self.row, other.row)
        right = max(self.column + self.columns, other.column + other.columns)
        top = max(self.row + self.rows, other.row + other.rows)
        return Patch(column, row, right - column, top - row)

    def clipped(self, outer: "Patch") -> "Patch | None":
        """Give its part within another one; None if there is none."""
        column, row = max(self.column, outer.column), max(self.row, outer.row)
        columns = min(self.column + self.columns, outer.column + outer.columns) - column
        rows = min(self.row + self.rows, outer.row + outer.rows) - row
        return Patch(column, row, columns, rows) if columns > 0 and rows > 0 else None

    def grown(self, block: int = GROWTH_CELLS) -> "Patch":
        """Give the smallest one around it whose edges are multiples of a block."""
        column, row = floor(self.column / block) * block, floor(self.row / block) * block
        right = ceil((self.column + self.columns) / block) * block
        top = ceil((self.row + self.rows) / block) * block
        return Patch(column, row, right - column, top - row)

    def within(self, outer: "Patch") -> tuple[slice, slice]:
        """Give rows and columns of its cells in those of an outer one."""
        row, column = self.row - outer.row, self.column - outer.column
        return slice(row, row + self.rows), slice(column, column + self.columns)


def patch_over(bounds: Bounds, resolution_m: float) -> Patch:
    """Give the cells that an area touches."""
    column, row = floor(bounds[0] / resolution_m), floor(bounds[1] / resolution_m)
    right, top = ceil(bounds[2] / resolution_m), ceil(bounds[3] / resolution_m)
    return Patch(column, row, max(right - column, 1), max(top - row, 1))


def cells_of(prediction: Prediction) -> Cells:
    """Give the probability in per cent, -1 where it is unknown; shaped as the prediction."""
    per_cent = np.rint(prediction.occupancy * _PER_CENT).astype(np.int8)
    return np.where(prediction.known, per_cent, np.int8(UNKNOWN))
