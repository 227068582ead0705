"""Where a map is, whatever one lost robot said: its bounds without far specks of evidence.

Sectors add up what their experts cover, and blocks what their sectors do. So a swap adds up the
sectors that it changed, and who asks adds up the blocks, of which a site has few.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Final

import numpy as np
from numpy.typing import NDArray

from gpom_core.member import (
    AREA,
    EXPERTS,
    NO_PART,
    OBSERVATIONS,
    SECTOR_M,
    Bounds,
)
from gpom_core.reach import index_of, tile_key
from gpom_core.shared import Shared

BLOCK_SECTORS: Final = 13  # along an edge
APART_M: Final = SECTOR_M * BLOCK_SECTORS
"""Evidence with so much nothing around it is a place of its own."""
SHARE_MIN: Final = 0.01
"""A place with less than this share of all evidence is a speck."""

_Part = NDArray[np.float64]
_Square = tuple[int, int]


def total(parts: Iterable[_Part]) -> _Part:
    """What several parts of a map cover together; see `member.NO_PART`."""
    every = np.array([NO_PART, *parts])
    out: _Part = every.min(axis=0)
    out[:AREA] = every[:, :AREA].sum(axis=0)
    return out


@dataclass(frozen=True, eq=False)
class Block:
    """A square of sectors; immutable.

    Attributes:
        parts: of those of its sectors that are home to experts, by the sector's key.
    """

    parts: Mapping[int, _Part]

    @cached_property
    def total(self) -> _Part:
        """Of all its sectors."""
        return total(self.parts.values())


Blocks = Shared[Block]


def updated(blocks: Blocks, changed: Mapping[int, _Part | None]) -> Blocks:
    """Blocks after some sectors, by key, came to cover another part of the map, or none."""
    squares: dict[int, dict[int, _Part]] = {}
    for key, part in changed.items():
        x, y = index_of(key)
        square = int(tile_key(x // BLOCK_SECTORS, y // BLOCK_SECTORS))
        if square not in squares:
            old = blocks.get(square)
            squares[square] = {} if old is None else dict(old.parts)
        if part is None or part[EXPERTS] == 0.0:
            squares[square].pop(key, None)
        else:
            squares[square][key] = part
    new = {square: Block(parts) for square, parts in squares.items() if parts}
    return blocks.updated(new, squares.keys() - new.keys())


def main_total(blocks: Blocks) -> _Part:
    """Of all blocks that are not in specks.

    One wrong pose puts evidence anywhere, and the smallest box around all of it is then useless for
    whoever wants to draw the map. A new wing of a building is near the old one, so it is no speck,
    and a second building is one only until it has its share.
    """
    totals = {index_of(key): block.total for key, block in blocks.items()}
    main = main_squares({square: float(one[OBSERVATIONS]) for square, one in totals.items()})
    return total(totals[square] for square in main)


def main_squares(weights: Mapping[_Square, float]) -> set[_Square]:
    """Those squares, by their share of the evidence, that are not in specks; at least one if any.

    Squares that touch, at corners too, are one place.
    """
    places = list(_places(weights.keys()))
    shares = [sum(weights[square] for square in place) for place in places]
    least = min(SHARE_MIN * sum(shares), max(shares, default=0.0))
    return set().union(
        *(place for place, share in zip(places, shares, strict=True) if share >= least)
    )


def _places(squares: Iterable[_Square]) -> Iterable[set[_Square]]:
    left = set(squares)
    while left:
        place, waiting = set[_Square](), [left.pop()]
        while waiting:
            x, y = square = waiting.pop()
            place.add(square)
            near = {(x + dx, y + dy) for dx in (-1, 0, 1) for dy in (-1, 0, 1)} & left
            left -= near
            waiting += near
        yield place


def area_of(part: _Part, first: int = AREA) -> Bounds | None:
    """xmin, ymin, xmax, ymax in metres of what a part covers, None if that is nothing.

    Args:
        first: `AREA`, of the evidence, or `REACH`, grown by how far evidence has a say.
    """
    if part[EXPERTS] == 0.0:
        return None
    xmin, ymin, xmax, ymax = part[first : first + 4].tolist()
    return xmin, ymin, -xmax, -ymax
