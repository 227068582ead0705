"""Batch clustering of the hits of many scans, for a mixture of experts.

A clustering is an argument: anything that gives each hit a cluster number. Here are the two that
Kim & Kim compare, and the trivial one that turns the mixture into a single Gaussian process.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from math import inf
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from gpom_core.dirichlet import NormalInverseWishart, sample_clusters
from gpom_core.lines import moments_of, principal_axis
from gpom_core.scan import Scan

_Floats = NDArray[np.float64]
_Labels = NDArray[np.int64]

_GAP_IN_BEAMS = 3.0  # a wall seen at a slant spreads neighbouring hits this much, and no more


class Clustering(Protocol):
    """Gives every hit of a batch of scans a cluster."""

    def __call__(self, scans: Sequence[Scan]) -> _Labels:
        """Cluster number 0, 1, … of each hit (n,), hits in order of `hits_of`."""
        ...


def hits_of(scans: Sequence[Scan]) -> _Floats:
    """End points (n, 2) of all beams that returned, scan by scan in order of angle, metres."""
    return np.concatenate([np.empty((0, 2)), *(_hits(scan) for scan in scans)])


@dataclass(frozen=True, slots=True)
class OneCluster:
    """All in one: a single Gaussian process."""

    def __call__(self, scans: Sequence[Scan]) -> _Labels:
        """Cluster 0 for each hit."""
        return np.zeros(len(hits_of(scans)), np.int64)


@dataclass(frozen=True, slots=True)
class DirichletProcess:
    """Gaussian clusters, their number inferred (eq. 1-4); see `gpom_core.dirichlet`.

    Attributes:
        extent_m: standard deviation that clusters are expected to have.
        concentration, sweeps, seed: of the sampler.
    """

    extent_m: float = 1.0
    concentration: float = 1.0
    sweeps: int = 100
    seed: int = 0

    def __call__(self, scans: Sequence[Scan]) -> _Labels:
        """The most probable sampled partition of the hits."""
        points = hits_of(scans)
        if len(points) == 0:
            return np.zeros(0, np.int64)
        labels, _ = sample_clusters(
            points,
            NormalInverseWishart.around(points, self.extent_m),
            concentration=self.concentration,
            sweeps=self.sweeps,
            seed=self.seed,
        )
        return labels


@dataclass(frozen=True, slots=True)
class LineTracking:
    """Clusters of collinear neighbours (the paper's Algorithm 1), scan by scan.

    The ordered hits of a scan are split into straight runs, and a run joins the cluster whose line
    it prolongs or covers. Unlike `gpom_core.lines`, made for dense scans, every run is checked
    from its third hit on: of 17 beams a corner is not left out of a line by its many hits.

    Attributes:
        tolerance_m: farthest that a hit may lie from the line of its cluster.
        gap_m: longest distance between neighbours of a cluster, or 3 spacings of beams.
        least_hits: smaller clusters join the nearest, since two hits do not make a line.
        longest_m: a longer cluster is cut into parts of equally many hits, as many as its length
            needs.
    """

    tolerance_m: float = 0.15
    gap_m: float = 1.0
    least_hits: int = 3
    longest_m: float = inf

    def __call__(self, scans: Sequence[Scan]) -> _Labels:
        """Number of the tracked line of each hit."""
        groups: list[list[int]] = []
        points = hits_of(scans)
        first = 0
        for scan in scans:
            spacing_m = scan.ranges_m[scan.hits()] * abs(scan.angle_increment_rad)
            for run in self._runs(points, first, spacing_m.astype(np.float64)):
                self._join(points, groups, run, float(spacing_m[np.array(run) - first].max()))
            first += len(spacing_m)
        groups = self._without_small(points, groups)
        labels = np.zeros(len(points), np.int64)
        number = 0
        for group in groups:
            for part in self._cut(points, np.array(group)):
                labels[part] = number
                number += 1
        return labels

    def _runs(self, points: _Floats, first: int, spacing_m: _Floats) -> list[list[int]]:
        runs: list[list[int]] = []
        for i in range(first, first + len(spacing_m)):
            reach_m = max(self.gap_m, _GAP_IN_BEAMS * spacing_m[i - first])
            if (
                runs
                and np.hypot(*(points[i] - points[i - 1])) <= reach_m
                and _off_line(points[[*runs[-1], i]]) <= self.tolerance_m
            ):
                runs[-1].append(i)
            else:
                runs.append([i])
        return runs

    def _join(
        self, points: _Floats, groups: list[list[int]], run: list[int], spacing_m: float
    ) -> None:
        """Put a run into the cluster that it fits best, or into a new one."""
        best, least = None, self.tolerance_m
        reach_m = max(self.gap_m, spacing_m)
        for group in groups:
            if _distance(points[group], points[run]) <= reach_m:
                off_m = _off_line(points[group + run])
                if off_m <= least:
                    best, least = group, off_m
        if best is None:
            groups.append(list(run))
        else:
            best.extend(run)

    def _without_small(self, points: _Floats, groups: list[list[int]]) -> list[list[int]]:
        large = [group for group in groups if len(group) >= self.least_hits]
        if not large:
            return [[i for group in groups for i in group]] if groups else []
        grown = [list(group) for group in large]
        for group in groups:
            if len(group) < self.least_hits:
                for i in group:
                    distances = [_distance(points[g], points[[i]]) for g in large]
                    grown[int(np.argmin(distances))].append(i)
        return grown

    def _cut(self, points: _Floats, group: _Labels) -> list[_Labels]:
        along = _along_line(points[group])
        parts = int(np.ceil(np.ptp(along) / self.longest_m)) if self.longest_m < inf else 1
        order = group[np.argsort(along, kind="stable")]
        return [part for part in np.array_split(order, max(parts, 1)) if len(part) > 0]


def _hits(scan: Scan) -> _Floats:
    hit = scan.hits()
    angle = scan.beam_angles_rad()[hit]
    ranges_m = scan.ranges_m[hit].astype(np.float64)
    direction = np.column_stack([np.cos(angle), np.sin(angle)])
    ends: _Floats = np.array([scan.pose.x_m, scan.pose.y_m]) + ranges_m[:, None] * direction
    return ends


def _axis(points: _Floats) -> tuple[_Floats, _Floats]:
    """Points (n, 2) relative to their mean, and the direction of their line."""
    centred = points - points.mean(axis=0)
    moments = np.zeros(6)
    moments_of(centred, moments)
    _, _, tx, ty, _, _ = principal_axis(moments)
    return centred, np.array([tx, ty])


def _off_line(points: _Floats) -> float:
    """Largest distance of points (n, 2) from the line fitted to them."""
    centred, axis = _axis(points)
    return float(np.abs(centred @ np.array([-axis[1], axis[0]])).max())


def _along_line(points: _Floats) -> _Floats:
    centred, axis = _axis(points)
    along: _Floats = centred @ axis
    return along


def _distance(a: _Floats, b: _Floats) -> float:
    """Smallest distance between two sets of points."""
    difference = a[:, None] - b[None]
    return float(np.hypot(difference[..., 0], difference[..., 1]).min())
