"""Tiles that were drawn, kept while the map under them stays as it is.

A tile is known by its stamp: the map version that last changed something under it. Tiles that a
change does not touch keep their stamp, so neither this store nor a browser draws them again.
"""

import threading
from collections import OrderedDict
from collections.abc import Callable
from concurrent.futures import Future
from dataclasses import dataclass

from gpom_core.changes import SQUARE_M, Square, changed_squares
from gpom_core.snapshot import Snapshot
from service.query_desk import QueryDesk
from service.tile_raster import Theme, TileLayer, draw, empty
from service.tile_scheme import TileAddress

_ENTRY_BYTES = 400  # what an entry costs beside its picture, about


@dataclass(frozen=True, slots=True)
class Stamps:
    """When each square of the map changed last; replaced as a whole, so readers need no lock."""

    snapshot: Snapshot
    versions: dict[Square, int]

    def followed_by(self, snapshot: Snapshot) -> "Stamps":
        """Note what differs in another version."""
        changed = changed_squares(self.snapshot, snapshot)
        if not changed:
            return Stamps(snapshot, self.versions)
        return Stamps(snapshot, self.versions | dict.fromkeys(changed, snapshot.version))

    def of(self, tile: TileAddress) -> int:
        """Give the version that changed a tile last; 0 where nothing was ever known."""
        columns, rows = tile.squares(SQUARE_M)
        if len(columns) * len(rows) <= len(self.versions):
            found = (self.versions.get((x, y), 0) for x in columns for y in rows)
        else:
            found = (
                version for (x, y), version in self.versions.items() if x in columns and y in rows
            )
        return max(found, default=0)


@dataclass(frozen=True, slots=True)
class TileKey:
    """Which picture; the same key is the same picture."""

    tile: TileAddress
    layer: TileLayer
    theme: Theme
    stamp: int
    draft: bool = False


class TileStore:
    """Draws tiles, a few at a time, each once, and remembers them within bounds.

    Drawing waits in a line of its own: a whole screen of tiles delays neither queries nor scans.
    """

    def __init__(self, desk: QueryDesk, bytes_max: int) -> None:
        self._desk = desk
        self._bytes_max = bytes_max
        self._bytes = 0
        self._pictures: OrderedDict[TileKey, bytes] = OrderedDict()
        self._under_way: dict[TileKey, Future[bytes]] = {}
        self._stamps = Stamps(Snapshot(), {})
        self._lock = threading.Lock()
        self._empty = empty()
        self.drawn = 0

    @property
    def bytes_used(self) -> int:
        """Memory of the pictures that are remembered."""
        return self._bytes

    def stamps(self, snapshot: Snapshot) -> Stamps:
        """Bring the stamps up to a version of the map; older ones leave them as they are."""
        with self._lock:
            if snapshot is not self._stamps.snapshot and (
                snapshot.version >= self._stamps.snapshot.version
            ):
                self._stamps = self._stamps.followed_by(snapshot)
            return self._stamps

    def has(self, key: TileKey) -> bool:
        """Tell whether a picture is here already."""
        return key.stamp == 0 or key in self._pictures

    def picture(self, key: TileKey, snapshot: Snapshot) -> "bytes | Future[bytes]":
        """Give a tile's PNG at once, or a future of it.

        Args:
            key: with the stamp of `snapshot`.
            snapshot: to draw from.

        Raises:
            BusyError: too many tiles wait already.
        """
        if key.stamp == 0:
            return self._empty
        with self._lock:
            if (picture := self._pictures.get(key)) is not None:
                self._pictures.move_to_end(key)
                return picture
            if (future := self._under_way.get(key)) is not None:
                return future
            future = self._desk.submit(self._drawing(key, snapshot))
            self._under_way[key] = future
        future.add_done_callback(lambda done: self._keep(key, done))
        return future

    def _drawing(self, key: TileKey, snapshot: Snapshot) -> Callable[[], bytes]:
        return lambda: draw(snapshot, key.tile, key.layer, key.theme, draft=key.draft)

    def _keep(self, key: TileKey, done: "Future[bytes]") -> None:
        with self._lock:
            self._under_way.pop(key, None)
            if done.cancelled() or done.exception() is not None:
                return
            self.drawn += 1
            self._pictures[key] = done.result()
            self._bytes += _size(done.result())
            while self._bytes > self._bytes_max:
                _, oldest = self._pictures.popitem(last=False)
                self._bytes -= _size(oldest)


def _size(picture: bytes) -> int:
    return len(picture) + _ENTRY_BYTES
