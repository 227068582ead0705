"""The committee beside one exact Gaussian process over the same evidence, on windows of a log.

Committee and process read the same merged observations with the same kernel and noise, so every
difference is what dividing costs. Each is calibrated on its own evidence, left out.
"""

import os
from dataclasses import replace

import numpy as np
import pytest

from clients.protocol import LabelledPoints, hit_ends, labelled_points, split
from gpom_core.config import MapConfig
from gpom_core.expert import Hyperparameters
from gpom_core.mapper import Mapper
from gpom_core.member import CUTOFF_SCALES, Member, train_member
from gpom_core.metrics import negative_log_likelihood
from gpom_core.observations import Observations
from gpom_core.scan import Scan
from gpom_core.snapshot import Snapshot
from tests.benchmarks.logs import real_log

WINDOW_M = 2.5
EVERY = 3  # training scans that are used
SIZES = ((40, 0.75), (80, 1.5), (160, 3.0), (320, 6.0), (640, 12.0))
FUSIONS = ("bcm", "rbcm", "poe")


def some(observations: Observations, kept: np.ndarray) -> Observations:
    names = ("kinds", "geometry", "targets", "noise_variance", "count")
    arrays = {n: np.ascontiguousarray(getattr(observations, n)[kept]) for n in names}
    return replace(observations, **arrays)


def together(parts: list[Observations]) -> Observations:
    names = ("kinds", "geometry", "targets", "noise_variance", "count")
    return Observations(**{n: np.concatenate([getattr(p, n) for p in parts]) for n in names})


def windows(test: LabelledPoints, count: int) -> list[np.ndarray]:
    """Low corners of those squares that hold the most test points of the rarer kind."""
    cells = np.floor(test.points / WINDOW_M).astype(int)
    found, which = np.unique(cells, axis=0, return_inverse=True)
    hits = np.bincount(which.ravel(), weights=test.occupied)
    free = np.bincount(which.ravel(), weights=~test.occupied)
    best = np.argsort(-np.minimum(hits, free), kind="stable")[:count]
    return [found[b] * WINDOW_M for b in best]


def near_window(scans: list[Scan], corner: np.ndarray) -> list[Scan]:
    centre = corner + WINDOW_M / 2
    return [s for s in scans if (np.abs(hit_ends(s) - centre).max(axis=1) < WINDOW_M).any()]


def committee_and_exact(
    scans: list[Scan], corner: np.ndarray, config: MapConfig
) -> tuple[Snapshot, Snapshot, list[Observations]]:
    mapper = Mapper(config)
    for scan in scans:
        mapper.update(scan)
    margin = CUTOFF_SCALES * config.length_scale_m
    parts = []
    whole = mapper.train()
    for member in whole.members.values():
        o = member.expert.observations
        near = (o.geometry[:, 1] >= corner - margin).all(1)
        near &= (o.geometry[:, 0] <= corner + WINDOW_M + margin).all(1)
        if near.any():
            parts.append(some(o, near))
    prior = Hyperparameters(config.length_scale_m, config.signal_std)

    def member(number: int, observations: Observations) -> Member:
        return train_member(number, 1, observations, prior, np.zeros((2, 2)))

    def of(groups: list[Observations]) -> Snapshot:
        snapshot = Snapshot().swapped([member(i, group) for i, group in enumerate(groups)])
        return snapshot.with_link(whole.link)

    return of(parts), of([together(parts)]), parts


def at_border(points: np.ndarray, parts: list[Observations], length_m: float) -> np.ndarray:
    """Points about as near to the evidence of a second expert as to that of the first."""
    nearest = [
        np.linalg.norm(points[:, None] - p.geometry.mean(axis=1)[None], axis=2).min(axis=1)
        for p in parts
    ]
    first, second = np.sort(np.array(nearest), axis=0)[:2]
    return np.asarray(second - first < length_m / 2)


@pytest.mark.benchmark
@pytest.mark.timeout(1200)
def test_committee_beside_the_exact_process() -> None:
    training, held_out = split(real_log("intel"))
    test = labelled_points(held_out, seed=0)
    corners = windows(test, int(os.environ.get("GPOM_WINDOWS", "3")))
    print(f"\n{'experts of':>10} {'rule':6}{'NLL':>8}{'d mean':>8}{'border':>8}{'var ratio':>10}")
    for size, length_m in SIZES:
        config = MapConfig(max_observations=size, max_length_m=length_m)
        rows: dict[str, list[np.ndarray]] = {name: [] for name in ("exact", *FUSIONS)}
        labels, experts, observations = [], 0, 0
        for corner in corners:
            inside = ((test.points >= corner) & (test.points < corner + WINDOW_M)).all(axis=1)
            asked = test.where(inside)
            scans = near_window(training[::EVERY], corner)
            committee, exact, parts = committee_and_exact(scans, corner, config)
            border = at_border(asked.points, parts, config.length_scale_m)
            experts, observations = experts + len(parts), observations + sum(map(len, parts))
            truth = exact.query(asked.points)
            labels.append(asked.occupied)
            for name, answers in rows.items():
                map_, rule = (exact, "bcm") if name == "exact" else (committee, name)
                p = map_.query(asked.points, rule)
                off, ratio = np.abs(p.mean - truth.mean), np.log(p.variance / truth.variance)
                answers.append(np.stack([p.occupancy, off, ratio, border]))
        occupied = np.concatenate(labels)
        print(f"-- {experts} experts, {observations} observations, {len(occupied)} points")
        for name, columns in rows.items():
            p, off, ratio, border = np.concatenate(columns, axis=1)
            near = off[border > 0].mean() if border.any() else 0.0
            print(
                f"{size:10} {name:6}{negative_log_likelihood(p, occupied):8.4f}{off.mean():8.4f}"
                f"{near:8.4f}{np.exp(ratio.mean()):10.3f}",
                flush=True,
            )
