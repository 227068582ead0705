"""All evidence of the map, merged and clustered, as scans come in."""

from __future__ import annotations

from operator import is_
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from gpom_core import clusters, news, rows, sight, tiles
from gpom_core.beams import absorb_free_segments
from gpom_core.config import MapConfig
from gpom_core.errors import InvalidScanError
from gpom_core.handles import handle
from gpom_core.integrate import SEGMENTS, integrate
from gpom_core.observations import Seen, Weighing, observe
from gpom_core.scan import Scan


class UpdateReport(NamedTuple):
    """What one scan brought: its hits, and how many rows of evidence are new."""

    hits: int
    new_observations: int


class Evidence:
    """The mutable holder of rows and clusters. One thread owns it."""

    def __init__(self, config: MapConfig) -> None:
        self.config = config
        self._rules = tuple(float(getattr(config, name)) for name in sight.Rules._fields)
        self._weighing = Weighing(*(getattr(config, name) for name in Weighing._fields))
        self.rows = rows.new_rows()
        self.tiles = tiles.new_tiles()
        self.clusters = clusters.new_clusters()
        self._sight = sight.new_sight()
        self._known: tuple[object, ...] = ()
        self._addresses: list[NDArray[np.int64]] = []

    @property
    def observation_count(self) -> int:
        """Rows of evidence, before free areas are merged for training."""
        return int(self.rows.size[0])

    def add(self, scan: Scan) -> UpdateReport:
        """Integrate one scan: the way of the paper's Algorithm 1, online.

        Raises:
            InvalidScanError: the scan lies where the lattice has no cells; nothing was changed.
        """
        config, ranges_m = self.config, scan.ranges_m
        x_m, y_m, yaw_rad = scan.pose
        limits_m = scan.range_min_m, scan.range_max_m, min(scan.range_max_m, config.max_range_m)
        if max(abs(x_m), abs(y_m)) + limits_m[2] > rows.COORDINATE_LIMIT * config.hit_cell_m:
            raise self._too_far(scan)
        done, new = False, True
        while not done:
            done, hits, added, long = integrate(
                new, ranges_m, (x_m, y_m), (yaw_rad + scan.angle_min_rad, scan.angle_increment_rad),
                limits_m, self._rules, config.free_evidence == "segments", *self._handles(),
            )  # fmt: skip
            if not done:
                self._prepare(len(ranges_m))
            new = False
        if long:
            self._split_long(self._sight.long[:long])
        return UpdateReport(hits, added)

    def _too_far(self, scan: Scan) -> InvalidScanError:
        return InvalidScanError(
            "pose_out_of_range",
            f"the sensor is at {tuple(scan.pose)[:2]}, farther from the origin than the map's "
            f"lattice of {self.config.hit_cell_m} m cells can address; use a map frame near "
            "the site",
        )

    def _handles(self) -> list[NDArray[np.int64]]:
        """Addresses of all arrays, found anew when others are in their place."""
        held = self.rows, self.tiles, self.clusters, self._sight
        if not (self._known and all(map(is_, held, self._known))):
            self._known, self._addresses = held, [handle(arrays) for arrays in held]
        return self._addresses

    def _prepare(self, beams: int) -> None:
        """Do what a scan of so many beams, which was begun, needs to go on."""
        progress = self._sight.progress.tolist()
        if progress[sight.STAGE] == SEGMENTS:
            self._absorb_segments(progress[sight.BEAMS])
            return
        new_rows, new_tiles, new_clusters, window = progress[sight.NEEDED :]
        self.rows = rows.with_room(self.rows, new_rows)
        self.tiles = tiles.with_room(self.tiles, new_tiles)
        self.clusters = clusters.with_room(self.clusters, new_clusters)
        self._sight = sight.with_room(self._sight, beams, window)

    def _absorb_segments(self, beams: int) -> None:
        seen, c = self._sight, self.config
        free_m = seen.free_m[:beams]
        pieces = np.ceil(np.maximum(free_m, 0.0) / c.segment_m)
        self.rows = rows.with_room(self.rows, int(pieces.sum()))
        absorb_free_segments(
            seen.origin, seen.direction[:beams], free_m, seen.homes[:beams],
            self.rows, self.clusters, c.segment_m, 0.5 * c.segment_m, c.free_cap,
        )  # fmt: skip

    def _split_long(self, long: NDArray[np.int32]) -> None:
        waiting = long.tolist()
        while waiting:
            halves = np.array(self.split(waiting.pop(), by_hits=True), np.int32)
            more = clusters.longer_than(self.clusters, halves, self.config.max_length_m)
            waiting += more.tolist()

    def split(self, cluster: int, *, by_hits: bool) -> list[int]:
        """Halve a cluster; both halves, both dirty, or nothing if it cannot be halved."""
        self.clusters = clusters.with_room(self.clusters, 1)
        new = int(clusters.split(self.rows, self.clusters, cluster, by_hits))
        if new == rows.NONE:
            return []
        for half in (cluster, new):
            self.clusters.fresh[half] += 1
        return [cluster, new]

    def dirty(self) -> NDArray[np.int64]:
        """Clusters whose evidence changed since they were taken, most changed first."""
        n, c = int(self.clusters.size[0]), self.config
        fresh, gain = self.clusters.fresh[:n], self.clusters.gain[:n]
        owned = self.clusters.rows[:n]
        suspects = np.flatnonzero((fresh == 0) & (gain > c.retrain_gain * owned))
        if len(suspects):
            news.judge(
                suspects, self.rows, self.tiles, self.clusters, c.cell_m, c.hit_cap, c.free_cap,
                (c.free_noise_std / c.hit_noise_std) ** 2, c.retrain_gain,
            )  # fmt: skip
        untrained = (self.clusters.revision[:n] == 0) & (owned > 0)
        changed = np.flatnonzero((fresh > 0) | untrained)
        return changed[np.argsort(-(fresh + gain)[changed], kind="stable")]

    def refresh(self) -> None:
        """Make every cluster dirty whose evidence changed since it was taken, however little."""
        n = int(self.clusters.size[0])
        changed = (self.clusters.gain[:n] > 0.0) & (self.clusters.rows[:n] > 0)
        self.clusters.fresh[:n] += changed

    def take(self, cluster: int) -> tuple[int, Seen]:
        """The evidence of a cluster to train on, and its revision; it is clean from here on."""
        self.clusters.fresh[cluster] = 0
        self.clusters.gain[cluster] = 0.0
        self.clusters.revision[cluster] += 1
        seen = observe(self.rows, self.clusters, cluster, self._weighing)
        return int(self.clusters.revision[cluster]), seen
