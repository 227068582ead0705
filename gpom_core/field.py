"""The field: the committee's sums on a sparse lattice, filled where many points are asked for.

Filling a tile costs as much as some hundred exact answers, and the map changes while robots drive.
So the first points in a tile are answered exactly, and it is filled when they would have paid for
it: what is asked costs at most twice the cheaper of the two ways.

What a tile holds depends on the experts that reach it and on nothing else; how finely, also on what
an error meant for probabilities when it was filled. A new calibration keeps it: links of one map
differ little, and sums do not depend on them. Versions of the map share the sectors that did not
change, and with them the tiles; of a sector that changed only the tiles in reach of the changed
experts are forgotten. Everything here is replaced as a whole, never changed in place, so threads
need no lock: at worst two of them fill the same tile.
"""

from __future__ import annotations

from collections.abc import Mapping
from copy import copy
from dataclasses import dataclass
from itertools import count

import numpy as np
from numpy.typing import NDArray

from gpom_core.committee import OF_HITS, SUMS, Fusion
from gpom_core.lattice import fill_tile, interpolate, slots_of
from gpom_core.member import SECTOR_M, SECTOR_TILES, TILE_M, Bounds, sector_key
from gpom_core.pages import Nodes, Pages
from gpom_core.sector import Sector, committee_sums

TOLERANCE = 0.01  # of a probability in the middle of a cell; a tile that misses it is refined
FILL_AFTER = 256  # points in one tile: from then on filling it costs less than answering exactly
BYTES_MAX = 1 << 28  # of nodes, per fusion rule; the tiles used longest ago are forgotten first
_KEPT = 0.9  # share of the bytes that stays when there are too many

_ticks = count(1)
_NO_PAGES = Pages(np.empty(0, np.int64), {}, 0)


@dataclass(frozen=True, slots=True)
class _View:
    """Pages of all sectors, and where compiled code finds them."""

    pages: tuple[Pages, ...]
    books: NDArray[np.int64]

    def replaced(self, new: Mapping[int, tuple[Pages, NDArray[np.int64]]]) -> _View:
        """With other pages in some slots; slots beyond the last are new."""
        size = max([len(self.pages), *(slot + 1 for slot in new)])
        pages, books = list(self.pages), np.empty((size, 2), np.int64)
        pages += [_NO_PAGES] * (size - len(pages))
        books[: len(self.books)] = self.books
        for slot, (page, used) in new.items():
            pages[slot], books[slot] = page, (page.marks.ctypes.data, used.ctypes.data)
        return _View(tuple(pages), books)


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
        self._reach = np.array(reach)
        self._rule = Fusion.RBCM if fusion is Fusion.RBCM else Fusion.BCM
        self._negligible = negligible
        self._prior_variance = prior_variance
        self._weights = np.array(weights)
        self._bytes_max = BYTES_MAX
        self._slot_of: dict[int, int] = {}
        self._sectors: list[Sector] = []
        self._keys = np.empty(0, np.int64)
        self._slots = slots_of(self._keys)
        self._view = _View((), np.empty((0, 2), np.int64))
        self._put(sectors)

    def swapped(self, changed: Mapping[int, Sector], reach: Bounds) -> Field:
        """The field of the map in which some sectors are others; all else is shared."""
        later = copy(self)
        later._reach = np.array(reach)
        later._put(changed)
        return later

    def _put(self, sectors: Mapping[int, Sector]) -> None:
        new = [key for key in sectors if key not in self._slot_of]
        if new:
            more = {key: len(self._slot_of) + i for i, key in enumerate(new)}
            self._slot_of = self._slot_of | more
            self._keys = np.array(list(self._slot_of), np.int64)
            self._slots = slots_of(self._keys)
        self._sectors = [*self._sectors, *(sectors[key] for key in new)]
        for key, sector in sectors.items():
            self._sectors[self._slot_of[key]] = sector
        self._view = self._view.replaced({
            self._slot_of[key]: (sector.pages[self._rule], sector.used)
            for key, sector in sectors.items()
        })  # fmt: skip

    @property
    def size_bytes(self) -> int:
        """Memory of all tiles that are filled."""
        return sum(pages.size_bytes for pages in self._view.pages)

    def sums(self, points: NDArray[np.float64]) -> NDArray[np.float64]:
        """The committee's sums (n, 4) at points (n, 2), without the prior.

        Of those behind precision and information, the weights of hits and passes, it is log(1 + x):
        sums of narrow peaks, which only as logarithms can be interpolated.
        """
        sums = np.zeros((len(points), SUMS))
        late = np.empty(len(points), np.int64)
        tick, view = next(_ticks), self._view

        def read(which: NDArray[np.int64], view: _View) -> int:
            # The view is held here while its addresses are read.
            return interpolate(
                points, which, self._reach, self._keys, self._slots, view.books, tick, sums, late,
            )  # fmt: skip

        waiting = read(np.arange(len(points)), view)
        for slot, which in self._by_sector(points, late[:waiting].copy()).items():
            view = self._filled(slot, points[which])
            rare = late[: read(which, view)].copy()
            sector = self._sectors[slot]
            committee_sums(
                points, rare, sector.corner, sector.tables, sector.starts,
                sector.entries, int(self._rule), self._negligible, sums,
            )  # fmt: skip
            sums[rare, OF_HITS:] = np.log1p(sums[rare, OF_HITS:])
        return sums

    def _by_sector(
        self, points: NDArray[np.float64], which: NDArray[np.int64]
    ) -> dict[int, NDArray[np.int64]]:
        """Numbers of the points in each sector, by the sector's slot."""
        if len(which) == 0:
            return {}
        place = np.floor(points[which] / SECTOR_M).astype(np.int64)
        keys, sector = np.unique(sector_key(place[:, 0], place[:, 1]), return_inverse=True)
        return {self._slot_of[key]: which[sector == i] for i, key in enumerate(keys.tolist())}

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
            self._view = self._view.replaced({slot: (pages, sector.used)})
        view = self._view
        if filled:
            self._forget()
        return view

    def _tile(self, sector: Sector, tile: int) -> Nodes:
        corner = sector.corner + TILE_M * np.array(divmod(tile, SECTOR_TILES))
        return fill_tile(
            corner, sector.tables,
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
        left: dict[int, tuple[Pages, NDArray[np.int64]]] = {}
        for slot, tiles in gone.items():
            sector = self._sectors[slot]
            pages = sector.pages[self._rule].without(np.array(tiles))
            sector.pages[self._rule] = pages
            left[slot] = pages, sector.used
        self._view = view.replaced(left)
