"""Long questions, piece by piece: memory stays bounded, and nobody waits long for the end."""

from collections.abc import Callable, Iterable, Iterator

import numpy as np
from numpy.typing import NDArray

from gpom_core.member import Bounds
from gpom_core.snapshot import Prediction, Snapshot, grid_shape

PIECE_POINTS = 32_768

Check = Callable[[], None]
"""Called before each piece; raises to give up."""


def query(
    snapshot: Snapshot,
    points: NDArray[np.float64],
    fusion: str,
    check: Check,
    method: str = "exact",
) -> Prediction:
    """As `Snapshot.query`; points (N, 2)."""
    pieces = (points[at : at + PIECE_POINTS] for at in range(0, len(points) or 1, PIECE_POINTS))
    return _join(snapshot, pieces, fusion, check, method)


def grid(
    snapshot: Snapshot,
    bbox: Bounds,
    resolution_m: float,
    fusion: str,
    check: Check,
    method: str = "exact",
) -> Prediction:
    """As `Snapshot.grid`: the cell centres of a raster, (rows, columns), row 0 at ymin."""
    rows, columns = grid_shape(bbox, resolution_m)
    pieces = _centres(bbox, resolution_m, rows, columns)
    return _join(snapshot, pieces, fusion, check, method).reshape(rows, columns)


def _centres(
    bbox: Bounds, resolution_m: float, rows: int, columns: int
) -> Iterator[NDArray[np.float64]]:
    for at in range(0, rows * columns, PIECE_POINTS):
        row, column = np.divmod(np.arange(at, min(at + PIECE_POINTS, rows * columns)), columns)
        cells = np.column_stack((column, row)) + 0.5
        yield np.array(bbox[:2]) + cells * resolution_m


def _join(
    snapshot: Snapshot,
    pieces: Iterable[NDArray[np.float64]],
    fusion: str,
    check: Check,
    method: str,
) -> Prediction:
    answers = []
    for piece in pieces:
        check()
        answers.append(snapshot.query(piece, fusion, method))
    return Prediction(
        occupancy=np.concatenate([answer.occupancy for answer in answers]),
        mean=np.concatenate([answer.mean for answer in answers]),
        variance=np.concatenate([answer.variance for answer in answers]),
        known=np.concatenate([answer.known for answer in answers]),
    )
