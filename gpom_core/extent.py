"""Where a map is, whatever one lost robot said: its bounds without far specks of evidence."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np
from numpy.typing import NDArray

from gpom_core.member import Bounds

APART_M = 100.0
"""Evidence with so much nothing around it is a place of its own."""
SHARE_MIN = 0.01
"""A place with less than this share of all evidence is a speck."""

_Cell = tuple[int, int]


def in_main_places(bounds: Sequence[Bounds], weights: Sequence[int]) -> NDArray[np.bool_]:
    """Tell which of n pieces of evidence are not in specks.

    One wrong pose puts evidence anywhere, and the smallest box around all of it is then useless for
    whoever wants to draw the map. A new wing of a building is near the old one, so it is no speck,
    and a second building is one only until it has its share.

    Args:
        bounds: xmin, ymin, xmax, ymax of each, metres.
        weights: observations of each.

    Returns:
        (n,) of which at least one is true if n > 0.
    """
    boxes = np.asarray(bounds, np.float64).reshape(-1, 4)
    centres = 0.5 * (boxes[:, :2] + boxes[:, 2:])
    cells: list[_Cell] = [(x, y) for x, y in np.floor(centres / APART_M).astype(np.int64).tolist()]
    place_of = _places(set(cells))
    places = np.array([place_of[cell] for cell in cells], np.int64)
    shares = np.bincount(places, np.asarray(weights, np.float64))
    least = min(SHARE_MIN * float(shares.sum()), float(shares.max(initial=0.0)))
    return np.asarray(shares[places] >= least)


def _places(cells: set[_Cell]) -> dict[_Cell, int]:
    """Number groups of cells that touch, at corners too."""
    place_of: dict[_Cell, int] = {}
    number = 0
    for start in cells:
        if start in place_of:
            continue
        place_of[start] = number
        waiting = [start]
        while waiting:
            for cell in _around(waiting.pop()):
                if cell in cells and cell not in place_of:
                    place_of[cell] = number
                    waiting.append(cell)
        number += 1
    return place_of


def _around(cell: _Cell) -> Iterator[_Cell]:
    x, y = cell
    return ((x + dx, y + dy) for dx in (-1, 0, 1) for dy in (-1, 0, 1))
