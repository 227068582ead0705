"""All evidence of the map, merged and clustered, as scans come in."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from gpom_core import beams, clusters, lines, rows, tiles
from gpom_core.beams import POINT
from gpom_core.config import MapConfig
from gpom_core.errors import InvalidScanError
from gpom_core.observations import Observations, gather, observations_of
from gpom_core.scan import Scan
from gpom_core.similarity import most_similar


@dataclass(frozen=True, slots=True)
class UpdateReport:
    """What one scan brought: its hits, and how many rows of evidence are new."""

    hits: int
    new_observations: int


class Evidence:
    """The mutable holder of rows and clusters. One thread owns it."""

    def __init__(self, config: MapConfig) -> None:
        self.config = config
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
        beam = self._beams(scan)
        before, clusters_before = self.observation_count, int(self.clusters.size[0])
        hits = beam.ends[beam.returned]
        homes = self._associate(hits, beam.spacing_m[beam.returned])
        self._absorb_hits(hits, homes)
        self._absorb_free(beam, homes)
        self._forget_unused(clusters_before)
        self._split_long(np.unique(homes))
        return UpdateReport(
            hits=len(hits),
            new_observations=self.observation_count - before,
        )

    def _beams(self, scan: Scan) -> _Beams:
        """Beams that say something: those that returned, and those known to be free."""
        limit = min(scan.range_max_m, self.config.max_range_m)
        ranges = scan.ranges_m.astype(np.float64)
        hit, empty = scan.hits(), scan.no_returns()
        returned = hit & (ranges <= limit)
        used = hit | empty
        length = np.where(returned, ranges, limit)[used]
        angle = scan.beam_angles_rad()[used]
        direction = np.column_stack([np.cos(angle), np.sin(angle)])
        origin = np.array([scan.pose.x_m, scan.pose.y_m])
        if np.abs(origin).max() + limit > rows.COORDINATE_LIMIT * self.config.hit_cell_m:
            raise InvalidScanError(
                "pose_out_of_range",
                f"the sensor is at {tuple(origin)}, farther from the origin than the map's lattice "
                f"of {self.config.hit_cell_m} m cells can address; use a map frame near the site",
            )
        return _Beams(
            origin=origin,
            direction=direction,
            length_m=length,
            ends=origin + length[:, None] * direction,
            returned=returned[used],
            spacing_m=length * abs(scan.angle_increment_rad),
        )

    def _associate(
        self, hits: NDArray[np.float64], spacing_m: NDArray[np.float64]
    ) -> NDArray[np.int32]:
        c = self.config
        starts = lines.track_lines(hits, spacing_m, c.line_tolerance_m, c.line_gap_m)
        self.clusters = clusters.with_room(self.clusters, len(hits) + 1)
        return clusters.associate(
            hits, starts, self.rows, self.tiles, self.clusters, c.cell_m, c.line_tolerance_m
        )

    def _absorb_hits(self, hits: NDArray[np.float64], homes: NDArray[np.int32]) -> None:
        c = self.config
        self.rows = rows.with_room(self.rows, len(hits))
        self.tiles = tiles.with_room(self.tiles, len(hits))
        beams.absorb_hits(
            hits, homes, self.rows, self.tiles, self.clusters,
            c.hit_cell_m, c.cell_m, c.near_surface_m, c.hit_cap,
        )  # fmt: skip

    def _absorb_free(self, beam: _Beams, hit_homes: NDArray[np.int32]) -> None:
        """Free evidence goes with its beam's hit, or with the most similar beam's."""
        c = self.config
        homes = np.empty(len(beam.length_m), np.int32)
        homes[beam.returned] = hit_homes
        if not beam.returned.all():
            homes[~beam.returned] = self._homes_without_return(beam, hit_homes)
        free_m = np.where(beam.returned, beam.length_m - c.hit_margin_m, beam.length_m)
        start, n = 0, len(free_m)
        while start < n:
            if c.free_evidence == "areas":
                start, _ = beams.absorb_free_areas(
                    start, beam.origin, beam.direction, free_m, homes, self.rows, self.tiles,
                    self.clusters, c.cell_m, c.near_surface_m, c.free_cap,
                )  # fmt: skip
                room = beams.cells_crossed(c.max_range_m, c.cell_m)
            else:
                start, _ = beams.absorb_free_segments(
                    start, beam.origin, beam.direction, free_m, homes, self.rows, self.clusters,
                    c.segment_m, 0.5 * c.segment_m, c.free_cap,
                )  # fmt: skip
                room = int(c.max_range_m / c.segment_m) + 2
            if start < n:
                self.rows = rows.with_room(self.rows, room)
                self.tiles = tiles.with_room(self.tiles, room)

    def _homes_without_return(
        self, beam: _Beams, hit_homes: NDArray[np.int32]
    ) -> NDArray[np.int32]:
        """Cluster of each beam without return: that of the most similar returning beam.

        By the segment-segment kernel (section 3.1). A scan without any return founds a cluster.
        """
        silent, back = np.flatnonzero(~beam.returned), np.flatnonzero(beam.returned)
        if len(back) == 0:
            self.clusters = clusters.with_room(self.clusters, 1)
            return np.full(len(silent), clusters.add_cluster(self.clusters, *beam.origin), np.int32)
        like = most_similar(beam.ends - beam.origin, beam.returned, self.config.length_scale_m)
        return hit_homes[np.searchsorted(back, like[silent])]

    def _forget_unused(self, before: int) -> None:
        """Give back the numbers of clusters founded in vain: all they saw was known already."""
        size = int(self.clusters.size[0])
        while size > before and self.clusters.rows[size - 1] == 0:
            size -= 1
        self.clusters.size[0] = size

    def _split_long(self, touched: NDArray[np.int32]) -> None:
        limit = self.config.max_length_m
        waiting = clusters.longer_than(self.clusters, touched, limit).tolist()
        while waiting:
            halves = np.array(self.split(waiting.pop(), by_hits=True), np.int32)
            waiting += clusters.longer_than(self.clusters, halves, limit).tolist()

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
        n = int(self.clusters.size[0])
        fresh, gain = self.clusters.fresh[:n], self.clusters.gain[:n]
        score = fresh + gain
        changed = np.flatnonzero(
            (fresh > 0) | (gain > self.config.retrain_gain * self.clusters.rows[:n])
        )
        return changed[np.argsort(-score[changed], kind="stable")]

    def take(self, cluster: int) -> tuple[int, Observations]:
        """The evidence of a cluster to train on, and its revision; it is clean from here on."""
        self.clusters.fresh[cluster] = 0
        self.clusters.gain[cluster] = 0.0
        self.clusters.revision[cluster] += 1
        c = self.config
        observations = observations_of(
            self.rows, self.clusters, cluster,
            cell_m=c.cell_m, levels=c.coarse_levels, coarsen_ratio=c.coarsen_ratio,
            hit_noise_std=c.hit_noise_std, free_noise_std=c.free_noise_std,
            hit_cap=c.hit_cap, free_cap=c.free_cap,
        )  # fmt: skip
        return int(self.clusters.revision[cluster]), observations

    def line(self, cluster: int) -> NDArray[np.float64]:
        """Ends (2, 2) of the line of a cluster, from the hits it owns; its origin if none."""
        mine = gather(self.rows, self.clusters, cluster)
        xy = self.rows.geometry[mine[self.rows.kind[mine] == POINT], 0]
        if len(xy) == 0:
            return np.repeat(self.clusters.origin[cluster][None], 2, axis=0)
        moments = np.zeros(6)
        lines.moments_of(xy - xy[0], moments)
        cx, cy, tx, ty, _, _ = lines.principal_axis(moments)
        centre, axis = xy[0] + np.array([cx, cy]), np.array([tx, ty])
        along = (xy - centre) @ axis
        ends: NDArray[np.float64] = centre + np.array([[along.min()], [along.max()]]) * axis
        return ends


@dataclass(frozen=True, slots=True, eq=False)
class _Beams:
    """The n used beams of a scan in the map frame, metres."""

    origin: NDArray[np.float64]
    direction: NDArray[np.float64]
    length_m: NDArray[np.float64]
    ends: NDArray[np.float64]
    returned: NDArray[np.bool_]
    spacing_m: NDArray[np.float64]
