"""The paper's methods behind one interface: scans in, a map that answers points out."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from math import inf
from time import process_time
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from gpom_core.beam_calibration import calibrated
from gpom_core.clustering import Clustering, DirichletProcess, LineTracking, OneCluster
from gpom_core.committee import Fusion
from gpom_core.expert import Hyperparameters, train
from gpom_core.learning import LearningRule, learn
from gpom_core.mixture import Beams, Cluster, Mixture, beams_of, clusters_of
from gpom_core.scan import Scan

Floats = NDArray[np.float64]

SHARED = Hyperparameters(length_scale_m=0.8, signal_std=1.0)
HIT_NOISE_STD = 0.1
FREE_NOISE_STD = 0.1
RULE = LearningRule(spread=0.2, reach=2.0)
SEGMENT_M = 2.0
"""Longest piece of a beam where beams are cut; whole beams are the paper's."""
LONGEST_LINE_M = 2.0
DP_EXTENT_M = 1.0

GRID_RESOLUTION_M = 0.2
_GRID_STEP_M = 0.02
_HIT, _MISS, _LOW, _HIGH = 0.85, -0.4, -2.0, 3.5  # log odds, as OctoMap's


class Map(Protocol):
    """What every method makes of the scans."""

    @property
    def name(self) -> str:
        """Of the method, and of the fusion rule if it is not bcm."""
        ...

    @property
    def costs(self) -> Mapping[str, float]:
        """Processor time in s: clustering_s, learning_s."""
        ...

    @property
    def facts(self) -> Mapping[str, float]:
        """How many clusters, observations and so on."""
        ...

    def occupancy(self, points: Floats) -> Floats:
        """Probability of being occupied at points (m, 2), (m,)."""
        ...

    def variance(self, points: Floats) -> Floats:
        """How unsure the map is at points (m, 2), (m,)."""
        ...


class Method(Protocol):
    """Makes a map of scans."""

    @property
    def name(self) -> str:
        """For tables and figures."""
        ...

    def fit(self, scans: Sequence[Scan]) -> Map:
        """Cluster, learn and train."""
        ...


@dataclass(frozen=True, slots=True)
class MixtureMethod:
    """A mixture of Gaussian processes; with `OneCluster` a single one.

    Attributes:
        segment_m: longest line observation; inf for whole beams.
    """

    name: str
    clustering: Clustering
    segment_m: float = inf

    def fit(self, scans: Sequence[Scan]) -> "MixtureMap":
        """Cluster the hits, assign the beams, learn each expert, train it, calibrate them all."""
        started = process_time()
        clusters = clusters_of(
            scans,
            self.clustering,
            length_scale_m=SHARED.length_scale_m,
            hit_noise_std=HIT_NOISE_STD,
            free_noise_std=FREE_NOISE_STD,
            segment_m=self.segment_m,
        )
        clustered = process_time()
        learned = [learn(c.observations, SHARED, rule=RULE) for c in clusters]
        done = process_time()
        experts = tuple(
            train(c.observations, found.hyperparameters)
            for c, found in zip(clusters, learned, strict=True)
        )
        beams = beams_of(scans)
        sizes = [len(c.observations) for c in clusters]
        return MixtureMap(
            name=self.name,
            mixture=calibrated(Mixture(experts), clusters, beams),
            clusters=tuple(clusters),
            beams=beams,
            costs={"clustering_s": clustered - started, "learning_s": done - clustered},
            facts={
                "clusters": len(clusters),
                "observations": sum(sizes),
                "largest_expert": max(sizes),
                "evaluations": sum(found.evaluations for found in learned),
                "median_length_scale_m": float(
                    np.median([found.hyperparameters.length_scale_m for found in learned])
                ),
            },
        )


@dataclass(frozen=True, slots=True, eq=False)
class MixtureMap:
    """A trained mixture with what it was trained on."""

    name: str
    mixture: Mixture
    clusters: tuple[Cluster, ...]
    beams: Beams
    costs: Mapping[str, float]
    facts: Mapping[str, float]

    def occupancy(self, points: Floats) -> Floats:
        """See `Map.occupancy`."""
        return self.mixture.occupancy(points)

    def variance(self, points: Floats) -> Floats:
        """Variance of the latent function."""
        return self.mixture.latent(points)[1]

    def fused_by(self, fusion: Fusion) -> "MixtureMap":
        """The same experts under another rule, calibrated anew: each rule at its best."""
        other = calibrated(self.mixture.with_fusion(fusion), self.clusters, self.beams)
        return MixtureMap(
            f"{self.name} {fusion.name.lower()}", other, self.clusters, self.beams, self.costs,
            self.facts,
        )  # fmt: skip


@dataclass(frozen=True, slots=True)
class GridMethod:
    """An occupancy grid of clamped log odds; beams without return count as free too."""

    name: str = "grid"
    resolution_m: float = GRID_RESOLUTION_M

    def fit(self, scans: Sequence[Scan]) -> "GridMap":
        """Count every cell at most once per scan, a hit beating a miss."""
        started = process_time()
        log_odds: dict[tuple[int, int], float] = {}
        for scan in scans:
            beams = beams_of([scan])
            hits = set(self._cells(beams.end[beams.returned]))
            length_m = np.hypot(*(beams.end - beams.origin).T)
            passed = [
                o + np.arange(0.0, 1.0, _GRID_STEP_M / length)[:, None] * (e - o)
                for o, e, length in zip(beams.origin, beams.end, length_m, strict=True)
            ]
            for cell in set(self._cells(np.concatenate(passed))) - hits:
                log_odds[cell] = max(log_odds.get(cell, 0.0) + _MISS, _LOW)
            for cell in hits:
                log_odds[cell] = min(log_odds.get(cell, 0.0) + _HIT, _HIGH)
        costs = {"clustering_s": 0.0, "learning_s": process_time() - started}
        return GridMap(self.name, self.resolution_m, log_odds, costs, {"cells": len(log_odds)})

    def _cells(self, points: Floats) -> list[tuple[int, int]]:
        return [(int(i), int(j)) for i, j in np.floor(points / self.resolution_m)]


@dataclass(frozen=True, slots=True, eq=False)
class GridMap:
    """Log odds per cell; a cell that nothing touched is 0."""

    name: str
    resolution_m: float
    log_odds: Mapping[tuple[int, int], float]
    costs: Mapping[str, float]
    facts: Mapping[str, float] = field(default_factory=dict)

    def occupancy(self, points: Floats) -> Floats:
        """Probability of the cell that holds the point."""
        cells = np.floor(points / self.resolution_m).astype(int).tolist()
        odds = np.array([self.log_odds.get((i, j), 0.0) for i, j in cells])
        return np.asarray(1.0 / (1.0 + np.exp(-odds)))

    def variance(self, points: Floats) -> Floats:
        """Variance of a coin of that probability: a grid has no other."""
        p = self.occupancy(points)
        return p * (1.0 - p)


def paper_methods(
    seed: int, *, with_single: bool = True, segment_m: float = inf
) -> list[MixtureMethod]:
    """Single process, Dirichlet process and line tracking, on the same evidence."""
    suffix = "" if segment_m == inf else ", cut beams"
    mixtures = [
        MixtureMethod(f"DP{suffix}", DirichletProcess(extent_m=DP_EXTENT_M, seed=seed), segment_m),
        MixtureMethod(f"LT{suffix}", LineTracking(longest_m=LONGEST_LINE_M), segment_m),
    ]
    single = [MixtureMethod(f"single GP{suffix}", OneCluster(), segment_m)]
    return single + mixtures if with_single else mixtures
