"""The field: the committee's sums on a sparse lattice, filled where many points are asked for.

Filling a tile costs as much as some hundred exact answers, and the map changes while robots drive.
So the first points in a tile are answered exactly, and it is filled when they would have paid for
it: what is asked costs at most twice the cheaper of the two ways.


A tile of the field depends on the experts that reach it and on nothing else. Versions of the map
share the sectors that did not change, and with them the tiles; of a sector that changed only the
tiles in reach of the changed experts are forgotten. Everything here is replaced as a whole, never
changed in place, so threads need no lock: at worst two of them fill the same tile.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from itertools import count

import numpy as np
from numpy.typing import NDArray

from gpom_core.committee import Fusion
from gpom_core.lattice import fill_tile, interpolate, slots_of
from gpom_core.member import SECTOR_TILES, TILE_M, Bounds
from gpom_core.pages import Nodes, Pages
from gpom_core.sector import Sector, committee_sums

TOLERANCE = 0.01  # of a probability in the middle of a cell; a tile that misses it is refined
FILL_AFTER = 256  # points in one tile: from then on filling it costs less than answering exactly
BYTES_MAX = 1 << 28  # of nodes, per fusion rule; the tiles used longest ago are forgotten first
_KEPT = 0.9  # share of the bytes that stays when there are too many

_ticks = count(1)


@dataclass(frozen=True, slots=True)
class _View:
    """Pages of all sectors, and where compiled code finds them."""

    pages: tuple[Pages, ...]
    books: NDArray[np.int64]

    def replaced(self, slot: int, pages: Pages, used: NDArray[np.int64]) -> _View:
        books = self.books.copy()
        books[slot] = _book(pages, used)
        return _View((*self.pages[:slot], pages, *self.pages[slot + 1 :]), books)


def _book(pages: Pages, used: NDArray[np.int64]) -> tuple[int, int]:
    return pages.marks.ctypes.data, used.ctypes.data


class Field:
    """The field of one version of the map under one fusion rule; any thread may ask it.

    Args:
        sectors: of the map. reach: what evidence can touch; beyond all is unknown.
        fusion: the contributions of `poe` are those of `bcm`, only its prior differs.
        negligible: as `opinions.tile_sums`.
        prior_variance, weights: of the map and its `Link`: what an error means for
            probabilities.
    """

    def __init__(
        self,
        sectors: Mapping[int, Sector],
        reach: Bounds,
        fusion: Fusion,
        *,
        negligible: float,
        prior_variance: float,
        weights: tuple[float, ...],
    ) -> None:
        self._sectors = tuple(sectors.values())
        self._reach = np.array(reach)
        self._rule = Fusion.RBCM if fusion is Fusion.RBCM else Fusion.BCM
        self._negligible = negligible
        self._prior_variance = prior_variance
        self._weights = np.array(weights)
        self._bytes_max = BYTES_MAX
        self._keys = np.array(list(sectors), np.int64)
        self._slots = slots_of(self._keys)
        pages = tuple(sector.pages[self._rule] for sector in self._sectors)
        books = [_book(p, s.used) for p, s in zip(pages, self._sectors, strict=True)]
        self._view = _View(pages, np.array(books, np.int64).reshape(-1, 2))

    @property
    def size_bytes(self) -> int:
        """Memory of all tiles that are filled."""
        return sum(pages.size_bytes for pages in self._view.pages)

    def sums(self, points: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Precision and information of the experts at points (n, 2), without the prior."""
        precision, information = np.zeros(len(points)), np.zeros(len(points))
        late = np.empty(len(points), np.int64)
        tick, view = next(_ticks), self._view

        def read(which: NDArray[np.int64], view: _View) -> int:
            # The view is held here while its addresses are read.
            return interpolate(
                points, which, self._reach, self._keys, self._slots, view.books, tick,
                precision, information, late,
            )  # fmt: skip

        waiting = read(np.arange(len(points)), view)
        for slot, which in self._by_sector(points, late[:waiting].copy()).items():
            view = self._filled(slot, points[which])
            rare = late[: read(which, view)].copy()
            sector = self._sectors[slot]
            committee_sums(
                points, rare, sector.corner, sector.tables, sector.scales, sector.starts,
                sector.entries, int(self._rule), self._negligible, precision, information,
            )  # fmt: skip
        return precision, information

    def _by_sector(
        self, points: NDArray[np.float64], which: NDArray[np.int64]
    ) -> dict[int, NDArray[np.int64]]:
        """Numbers of the points in each sector, by the sector's slot."""
        if len(which) == 0:
            return {}
        corners = np.array([sector.corner for sector in self._sectors])
        edge = SECTOR_TILES * TILE_M
        place = np.floor(points[which] / edge).astype(np.int64)
        slot_of = {
            (x, y): slot for slot, (x, y) in enumerate(np.rint(corners / edge).astype(int).tolist())
        }
        squares, square = np.unique(place, axis=0, return_inverse=True)
        return {
            slot_of[x, y]: which[square.ravel() == i] for i, (x, y) in enumerate(squares.tolist())
        }

    def _filled(self, slot: int, points: NDArray[np.float64]) -> _View:
        """A view in which those tiles of a sector are filled that were asked for often enough."""
        sector = self._sectors[slot]
        pages = sector.pages[self._rule]  # another version may have filled some meanwhile
        index = np.floor(points / TILE_M).astype(np.int64) & (SECTOR_TILES - 1)
        tiles = index[:, 0] * SECTOR_TILES + index[:, 1]
        np.add.at(sector.asked, tiles, 1)
        wanted = np.unique(tiles[sector.asked[tiles] >= FILL_AFTER]).tolist()
        filled = {tile: self._tile(sector, tile) for tile in wanted if not pages.has(tile)}
        if filled:
            pages = pages.with_tiles(filled)
            sector.pages[self._rule] = pages
        if pages is not self._view.pages[slot]:
            self._view = self._view.replaced(slot, pages, sector.used)
        view = self._view
        if filled:
            self._forget()
        return view

    def _tile(self, sector: Sector, tile: int) -> Nodes:
        corner = sector.corner + TILE_M * np.array(divmod(tile, SECTOR_TILES))
        return fill_tile(
            corner, sector.tables, sector.scales,
            sector.entries[sector.starts[tile] : sector.starts[tile + 1]], int(self._rule),
            self._negligible, self._prior_variance, self._weights, TOLERANCE,
        )  # fmt: skip

    def _forget(self) -> None:
        """Give up the tiles used longest ago when there are too many."""
        if self.size_bytes <= self._bytes_max:
            return
        view = self._view
        found = [
            (int(sector.used[tile]), slot, tile, nodes.nbytes)
            for slot, (sector, pages) in enumerate(zip(self._sectors, view.pages, strict=True))
            for tile, nodes in pages.nodes.items()
        ]
        too_many = sum(size for *_, size in found) - _KEPT * self._bytes_max
        gone: dict[int, list[int]] = {}
        for _, slot, tile, size in sorted(found):
            if too_many <= 0:
                break
            too_many -= size
            gone.setdefault(slot, []).append(tile)
        for slot, tiles in gone.items():
            sector = self._sectors[slot]
            pages = sector.pages[self._rule].without(np.array(tiles))
            sector.pages[self._rule] = pages
            view = view.replaced(slot, pages, sector.used)
        self._view = view
