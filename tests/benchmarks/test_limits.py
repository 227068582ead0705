"""Where the map is less right than its averages tell.

Short before surfaces, between the beams of thin maps, under another order of scans; and how far the
averages would move with other held-out scans.
"""

from fractions import Fraction

import numpy as np
import pytest

from clients.contenders import chosen_grids, gpom_map
from clients.protocol import Predict, far_from_beams, labelled_points, split, thin
from gpom_core.mapper import Mapper
from gpom_core.metrics import negative_log_likelihood
from gpom_core.scan import Scan
from gpom_core.snapshot import Snapshot
from tests.benchmarks.logs import real_log

BANDS_M = ((0.05, 0.1), (0.1, 0.2), (0.2, 0.3), (0.3, 0.5))
GAP_M = (0.1, 0.2)  # from the nearest training beam
SHARES = (Fraction(1), Fraction(1, 10))
RESAMPLED = 200
PLACES = 20_000


def short_of_hits(scans: list[Scan], low_m: float, high_m: float) -> np.ndarray:
    """A free place on each beam, so far before its hit, (n, 2)."""
    rng, found = np.random.default_rng(0), []
    for scan in scans:
        reach_m = scan.ranges_m.astype(np.float64)
        long = scan.hits() & (reach_m > 2.0 * high_m)
        angle = scan.beam_angles_rad()[long]
        along = reach_m[long] - rng.uniform(low_m, high_m, np.count_nonzero(long))
        way = np.column_stack([np.cos(angle), np.sin(angle)])
        found.append(np.array(scan.pose[:2]) + along[:, None] * way)
    return np.concatenate(found)


def trained(scans: list[Scan]) -> Snapshot:
    mapper = Mapper()
    for scan in scans:
        mapper.update(scan)
    return mapper.train()


def spread_over_scans(predict: Predict, held_out: list[Scan]) -> tuple[float, float]:
    """Likelihood at all held-out points, and its deviation over draws of the held-out scans."""
    losses = []
    for i, scan in enumerate(held_out):
        test = labelled_points([scan], seed=i, keep=None)
        if len(test):
            p = predict(test.points)[0]
            losses.append((negative_log_likelihood(p, test.occupied) * len(test), len(test)))
    table, rng = np.array(losses), np.random.default_rng(0)
    drawn = table[rng.integers(len(table), size=(RESAMPLED, len(table)))].sum(axis=1)
    return table[:, 0].sum() / table[:, 1].sum(), float(np.std(drawn[:, 0] / drawn[:, 1]))


@pytest.mark.benchmark
@pytest.mark.timeout(900)
@pytest.mark.parametrize("log", ["intel", "fr101", "aces"])
def test_short_before_surfaces_and_between_beams(log: str) -> None:
    training, held_out = split(real_log(log))
    for share in SHARES:
        scans = thin(training, share)
        test = labelled_points(held_out, seed=0, keep=None)
        beyond, within = (far_from_beams(test.points, scans, gap) for gap in GAP_M)
        gap = beyond & ~within
        for contender in [*gpom_map(scans), *chosen_grids(scans)[:2]]:
            line = f"| {log} | {share} | {contender.name} |"
            for low_m, high_m in BANDS_M:
                p, _ = contender.predict(short_of_hits(held_out, low_m, high_m))
                line += f" {negative_log_likelihood(p, np.zeros(len(p), np.bool_)):.2f} |"
            p, y = contender.predict(test.points[gap])[0], test.occupied[gap]
            line += f" {len(p)} | {y.mean():.2f} | {p.mean():.2f} |" if len(p) else " 0 | | |"
            if len(p):
                line += f" {negative_log_likelihood(p, y):.2f} |"
            nll, std = spread_over_scans(contender.predict, held_out)
            print(f"\n{line} {nll:.4f} ± {std:.4f} |", end="", flush=True)


@pytest.mark.benchmark
@pytest.mark.timeout(900)
@pytest.mark.parametrize(("log", "share"), [("intel", "1/10"), ("fr101", "1/3"), ("intel", "1")])
def test_another_order(log: str, share: str) -> None:
    training, held_out = split(real_log(log))
    scans = thin(training, Fraction(share))
    test = labelled_points(held_out, seed=0)
    low, high = test.points.min(axis=0), test.points.max(axis=0)
    places = np.random.default_rng(0).uniform(low, high, (PLACES, 2))
    first = trained(scans)
    shuffled = [scans[i] for i in np.random.default_rng(1).permutation(len(scans))]
    for order, other in (("reversed", scans[::-1]), ("shuffled", shuffled)):
        second = trained(other)
        apart = np.abs(first.query(places).occupancy - second.query(places).occupancy)
        known = first.query(places).known
        nll = [
            negative_log_likelihood(s.query(test.points).occupancy, test.occupied)
            for s in (first, second)
        ]
        print(
            f"\n| {log} | {share} | {order} | {np.quantile(apart[known], 0.95):.3f} "
            f"| {np.quantile(apart[known], 0.99):.3f} | {apart.max():.2f} "
            f"| {nll[0]:.4f}, {nll[1]:.4f} |", end="", flush=True,
        )  # fmt: skip
