"""The paper's batch mixture of Gaussian processes: beams, clusters of them, experts, one map.

The online map of `gpom_core.mapper` merges evidence and indexes it; this one keeps every beam as
it was made, and is small enough to be read beside the paper.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from math import inf

import numpy as np
from numpy.typing import NDArray

from gpom_core.calibration import Calibration
from gpom_core.clustering import Clustering, hits_of
from gpom_core.committee import Fusion, contribution
from gpom_core.expert import Expert
from gpom_core.jit import compiled
from gpom_core.kernels import cross, gram
from gpom_core.observations import FREE, OCCUPIED, Observations
from gpom_core.scan import Scan
from gpom_core.shapes import Kind

_Floats = NDArray[np.float64]
_Labels = NDArray[np.int64]

Cross = Callable[[NDArray[np.uint8], _Floats, _Floats, float], _Floats]
"""Kernel between points (m, 2) and shapes (n), as `kernels.cross`."""

REACH_SCALES = 3.5  # evidence farther away changes probabilities by less than 1e-3 (measured)
_BLOCK = 4096  # query points at a time
_TILE_M = 0.5  # points of one tile are near the same experts
_UNCALIBRATED = Calibration()


@dataclass(frozen=True, slots=True, eq=False)
class Beams:
    """The n beams of a batch of scans that say something.

    Attributes:
        origin, end: (n, 2) metres; the end of a beam without return is at the range limit.
        returned: (n,) whether it ended in a hit.
    """

    origin: _Floats
    end: _Floats
    returned: NDArray[np.bool_]

    @property
    def segments(self) -> _Floats:
        """The beams as line observations, (n, 2, 2)."""
        return np.stack([self.origin, self.end], axis=1)


@dataclass(frozen=True, slots=True, eq=False)
class Cluster:
    """The evidence of one expert, and which beam each of its n observations comes from, (n,)."""

    observations: Observations
    beam: _Labels


def beams_of(scans: Sequence[Scan]) -> Beams:
    """All beams that returned or saw nothing, scan by scan in order of angle."""
    origin, end, returned = [np.empty((0, 2))], [np.empty((0, 2))], [np.empty(0, np.bool_)]
    for scan in scans:
        hit = scan.hits()
        used = hit | scan.no_returns()
        length_m = np.where(hit, scan.ranges_m.astype(np.float64), scan.range_max_m)[used]
        angle = scan.beam_angles_rad()[used]
        start = np.array([scan.pose.x_m, scan.pose.y_m])
        direction = np.column_stack([np.cos(angle), np.sin(angle)])
        end.append(start + length_m[:, None] * direction)
        origin.append(np.broadcast_to(start, end[-1].shape))
        returned.append(hit[used])
    return Beams(np.concatenate(origin), np.concatenate(end), np.concatenate(returned))


def assign_beams(beams: Beams, hit_labels: _Labels, length_scale_m: float) -> _Labels:
    """Cluster of every beam (section 3.1).

    A beam that returned goes with its hit, one that did not with the most similar beam that did,
    by the kernel between lines. So no cluster has free evidence alone.

    Args:
        hit_labels: (h,) cluster of each hit, in order of the beams that returned.
    """
    labels = np.zeros(len(beams.returned), np.int64)
    labels[beams.returned] = hit_labels
    if beams.returned.any() and not beams.returned.all():
        kinds = np.full(len(labels), Kind.SEGMENT, np.uint8)
        similarity = gram(kinds, beams.segments, length_scale_m)
        most = np.argmax(similarity[~beams.returned][:, beams.returned], axis=1)
        labels[~beams.returned] = hit_labels[most]
    return labels


def clusters_of(
    scans: Sequence[Scan],
    clustering: Clustering,
    *,
    length_scale_m: float,
    hit_noise_std: float,
    free_noise_std: float,
    segment_m: float = inf,
) -> list[Cluster]:
    """The evidence of each expert: hits as points, beams as lines.

    Args:
        clustering: of the hits. length_scale_m: of the kernel that beams without return go by.
        segment_m: beams are cut evenly into pieces of at most this; inf for whole beams, as the
            paper has them.
    """
    beams = beams_of(scans)
    labels = assign_beams(beams, clustering(scans), length_scale_m)
    geometry, beam, is_hit = [], [], []
    for b, (origin, end) in enumerate(zip(beams.origin, beams.end, strict=True)):
        pieces = max(1, int(np.ceil(np.hypot(*(end - origin)) / segment_m)))
        cuts = origin + np.linspace(0.0, 1.0, pieces + 1)[:, None] * (end - origin)
        shapes = [*np.stack([cuts[:-1], cuts[1:]], axis=1)]
        if beams.returned[b]:
            shapes.append(np.stack([end, end]))
        geometry += shapes
        beam += [b] * len(shapes)
        is_hit += [False] * pieces + [True] * (len(shapes) - pieces)
    hit, which = np.array(is_hit, np.bool_), np.array(beam, np.int64)
    every = Observations(
        kinds=np.where(hit, Kind.POINT, Kind.SEGMENT).astype(np.uint8),
        geometry=np.array(geometry).reshape(-1, 2, 2),
        targets=np.where(hit, OCCUPIED, FREE),
        noise_variance=np.where(hit, hit_noise_std**2, free_noise_std**2),
        count=np.ones(len(hit)),
    )
    return [
        Cluster(_chosen(every, labels[which] == k), which[labels[which] == k])
        for k in np.unique(labels)
    ]


def _chosen(observations: Observations, mask: NDArray[np.bool_]) -> Observations:
    names = ("kinds", "geometry", "targets", "noise_variance", "count")
    return Observations(**{name: getattr(observations, name)[mask] for name in names})


@dataclass(frozen=True, slots=True, eq=False)
class Mixture:
    """Trained experts as one map; immutable. A single Gaussian process is a mixture of one.

    Attributes:
        prior_variance: of the latent function in unknown space.
        cross: kernel between query points and observations.
    """

    experts: tuple[Expert, ...]
    prior_variance: float = 1.0
    fusion: Fusion = Fusion.BCM
    calibration: Calibration = _UNCALIBRATED
    cross: Cross = cross

    def with_fusion(self, fusion: Fusion, calibration: Calibration | None = None) -> Mixture:
        """The same experts under another rule."""
        return replace(self, fusion=fusion, calibration=calibration or self.calibration)

    def latent(self, points: _Floats) -> tuple[_Floats, _Floats]:
        """Mean and variance of the latent function at points (m, 2), (m,) each (eq. 13)."""
        precision, information = self.sums(points)
        return information / precision, 1.0 / precision

    def occupancy(self, points: _Floats) -> _Floats:
        """Probability of being occupied at points (m, 2), (m,)."""
        return self.calibration.probability(*self.latent(points))

    def sums(self, points: _Floats) -> tuple[_Floats, _Floats]:
        """The committee's precision and information at points (m, 2); the prior is included."""
        priors = np.array([e.hyperparameters.signal_std**2 for e in self.experts])
        alone = float((1.0 / priors).sum()) if self.fusion == Fusion.POE else 0.0
        precision = np.full(len(points), alone or 1.0 / self.prior_variance)
        tiles, tile = _tiles_of(points)
        margin_m = _TILE_M * np.sqrt(points.shape[1]) / 2.0
        information = np.zeros(len(points))
        for expert, prior in zip(self.experts, priors, strict=True):
            cutoff_m = REACH_SCALES * expert.hyperparameters.length_scale_m
            shapes = expert.observations
            near = np.flatnonzero(
                is_near(tiles, shapes.kinds, shapes.geometry, cutoff_m + margin_m)[tile]
            )
            for block in np.array_split(near, len(near) // _BLOCK + 1):
                mean, variance = predict(expert, points[block], self.cross)
                add_opinion(
                    int(self.fusion), mean, variance, float(prior), block, precision, information
                )
        return precision, information


def _tiles_of(points: _Floats) -> tuple[_Floats, NDArray[np.intp]]:
    """Centres of the tiles that hold points (m, d), and the tile of each point."""
    index = np.floor(points / _TILE_M).astype(np.int64)
    low = index.min(axis=0, initial=0)
    size = index.max(axis=0, initial=0) - low + 1
    code = np.ravel_multi_index(tuple((index - low).T), tuple(size.tolist()))
    codes, tile = np.unique(code, return_inverse=True)
    corner = np.stack(np.unravel_index(codes, tuple(size.tolist())), axis=1) + low
    return (corner + 0.5) * _TILE_M, tile.reshape(-1)


def predict(expert: Expert, points: _Floats, cross: Cross = cross) -> tuple[_Floats, _Floats]:
    """One expert's mean and variance at points (m, 2), (m,) each (eq. 8-9)."""
    h, o = expert.hyperparameters, expert.observations
    signal = h.signal_std**2
    k = cross(o.kinds, o.geometry, points, h.length_scale_m)
    k *= signal
    explained = np.einsum("ij,ij->i", k @ expert.precision, k)
    return k @ expert.weights, np.clip(signal - explained, 1e-9 * signal, signal)


@compiled
def add_opinion(
    fusion: int,
    mean: _Floats,
    variance: _Floats,
    prior_variance: float,
    where: NDArray[np.intp],
    precision: _Floats,
    information: _Floats,
) -> None:
    """Add an expert's opinion at points `where` to the committee's sums."""
    for j in range(len(where)):
        p, i = contribution(fusion, mean[j], variance[j], prior_variance)
        precision[where[j]] += p
        information[where[j]] += i


@compiled
def is_near(
    points: _Floats, kinds: NDArray[np.uint8], geometry: _Floats, cutoff_m: float
) -> NDArray[np.bool_]:
    """Which points (m, d) are within the cut-off of any of the shapes (n, 2, d)."""
    m, d = points.shape
    near = np.zeros(m, np.bool_)
    for k in range(m):
        for i in range(len(geometry)):
            along, length2 = 0.0, 0.0
            for axis in range(d):
                span = geometry[i, 1, axis] - geometry[i, 0, axis]
                along += (points[k, axis] - geometry[i, 0, axis]) * span
                length2 += span * span
            share = min(max(along / length2, 0.0), 1.0) if length2 > 0.0 else 0.0
            distance2 = 0.0
            for axis in range(d):
                low, high = geometry[i, 0, axis], geometry[i, 1, axis]
                nearest = low + share * (high - low)
                if kinds[i] == 2:  # a box
                    nearest = min(max(points[k, axis], low), high)
                distance2 += (points[k, axis] - nearest) ** 2
            if distance2 < cutoff_m * cutoff_m:
                near[k] = True
                break
    return near


__all__ = ["Beams", "Cluster", "Mixture", "assign_beams", "beams_of", "clusters_of", "hits_of"]
