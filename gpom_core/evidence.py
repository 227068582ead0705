"""All evidence of the map, merged and clustered, as scans come in."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from gpom_core import areas, beams, clusters, news, open_space, rows, tiles
from gpom_core.config import MapConfig
from gpom_core.errors import InvalidScanError
from gpom_core.observations import Seen, Weighing, observe
from gpom_core.scan import Scan
from gpom_core.sight import Rules, Sight, see


@dataclass(frozen=True, slots=True)
class UpdateReport:
    """What one scan brought: its hits, and how many rows of evidence are new."""

    hits: int
    new_observations: int


class Evidence:
    """The mutable holder of rows and clusters. One thread owns it."""

    def __init__(self, config: MapConfig) -> None:
        self.config = config
        self._rules = Rules(*(float(getattr(config, name)) for name in Rules._fields))
        self._weighing = Weighing(*(getattr(config, name) for name in Weighing._fields))
        self.rows = rows.new_rows()
        self.tiles = tiles.new_tiles()
        self.clusters = clusters.new_clusters()

    @property
    def observation_count(self) -> int:
        """Rows of evidence, before free areas are merged for training."""
        return int(self.rows.size[0])

    def add(self, scan: Scan) -> UpdateReport:
        """Integrate one scan: the way of the paper's Algorithm 1, online.

        Raises:
            InvalidScanError: the scan lies where the lattice has no cells; nothing was changed.
        """
        limit_m = min(scan.range_max_m, self.config.max_range_m)
        self._check_place(scan, limit_m)
        before, clusters_before = self.observation_count, int(self.clusters.size[0])
        n = len(scan.ranges_m)
        self._make_room(n, n)
        self.clusters = clusters.with_room(self.clusters, n + 1)
        seen = see(
            scan.ranges_m,
            (scan.pose.x_m, scan.pose.y_m),
            (scan.pose.yaw_rad + scan.angle_min_rad, scan.angle_increment_rad),
            (scan.range_min_m, scan.range_max_m, limit_m),
            self._rules, self.rows, self.tiles, self.clusters,
        )  # fmt: skip
        close = int(self.tiles.size[tiles.CLOSE])
        if close:
            self._make_room(close * tiles.TILE_AREA, 0)
            open_space.divide_close(
                self.rows, self.tiles, self.clusters,
                self.config.cell_m, self.config.near_surface_m,
            )  # fmt: skip
        self._absorb_free(seen)
        self._forget_unused(clusters_before)
        if len(seen.long):
            self._split_long(seen.long)
        return UpdateReport(seen.hits, self.observation_count - before)

    def _check_place(self, scan: Scan, limit_m: float) -> None:
        farthest_m = max(abs(scan.pose.x_m), abs(scan.pose.y_m)) + limit_m
        if farthest_m > rows.COORDINATE_LIMIT * self.config.hit_cell_m:
            raise InvalidScanError(
                "pose_out_of_range",
                f"the sensor is at {tuple(scan.pose)[:2]}, farther from the origin than the map's "
                f"lattice of {self.config.hit_cell_m} m cells can address; use a map frame near "
                "the site",
            )

    def _make_room(self, new_rows: int, new_tiles: int) -> None:
        self.rows = rows.with_room(self.rows, new_rows)
        self.tiles = tiles.with_room(self.tiles, new_tiles)

    def _absorb_free(self, seen: Sight) -> None:
        """Free evidence goes with its beam's hit, or with the most similar beam's."""
        c = self.config
        if c.free_evidence == "segments":
            pieces = np.ceil(np.maximum(seen.free_m, 0.0) / c.segment_m)
            self._make_room(int(pieces.sum()), 0)
            beams.absorb_free_segments(
                seen.origin, seen.direction, seen.free_m, seen.homes, self.rows, self.clusters,
                c.segment_m, 0.5 * c.segment_m, c.free_cap,
            )  # fmt: skip
            return
        start = 0, 0
        while start[0] != rows.NONE:
            start = areas.absorb_free_areas(
                start, seen.origin, seen.direction, seen.free_m, seen.homes,
                self.rows, self.tiles, self.clusters, c.cell_m, c.near_surface_m,
                c.coarse_levels >= tiles.TILE_SHIFT, c.free_cap,
                c.hit_cap, (c.free_noise_std / c.hit_noise_std) ** 2,
            )  # fmt: skip
            if start[0] != rows.NONE:
                self._make_room(tiles.TILE_AREA, 1)
                self.clusters = clusters.with_room(self.clusters, 1)

    def _forget_unused(self, before: int) -> None:
        """Give back the numbers of clusters founded in vain: all they saw was known already."""
        size = int(self.clusters.size[0])
        while size > before and self.clusters.rows[size - 1] == 0:
            size -= 1
        self.clusters.size[0] = size

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
