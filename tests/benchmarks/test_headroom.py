"""What somebody could still gain who may learn from held-out scans: an upper bound, not a map.

Half of the held-out scans, in blocks of time, teach and the other half is scored, then the other
way round. Three learners: the map's own link, boosted trees on what the link hears, and boosted
trees that also get hits and passes smoothed over five widths and distances to training hits. The
map itself, which never sees a held-out scan, is scored on the same points.
"""

from fractions import Fraction

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter, map_coordinates
from scipy.spatial import cKDTree

from clients.protocol import hit_ends, labelled_points, split, thin
from gpom_core.committee import OF_HITS, OF_INFORMATION, OF_PASSES, OF_PRECISION
from gpom_core.link import fit, take_logarithms
from gpom_core.mapper import Mapper
from gpom_core.metrics import negative_log_likelihood
from gpom_core.scan import Scan
from gpom_core.snapshot import Snapshot
from tests.benchmarks.logs import real_log

SHARES = (Fraction(1), Fraction(1, 10))
BLOCKS = 20
CELL_M = 0.05
WIDTHS_M = (0.0, 0.05, 0.1, 0.2, 0.4)
NEAREST = (1, 4, 16)


def heard(snapshot: Snapshot, points: np.ndarray) -> np.ndarray:
    """What the link hears, (n, 4): mean, share of the prior variance left, hits, passes."""
    sums = snapshot.sums(points)
    take_logarithms(sums)
    left = 1.0 / (1.0 + snapshot.prior_variance * sums[:, OF_PRECISION])
    mean = sums[:, OF_INFORMATION] * left * snapshot.prior_variance
    return np.column_stack([mean, left, sums[:, OF_HITS], sums[:, OF_PASSES]])


def counts(scans: list[Scan], low: np.ndarray, shape: tuple[int, ...]) -> list[np.ndarray]:
    """Hits and passes of each cell."""
    hits, passes = np.zeros(shape), np.zeros(shape)
    for scan in scans:
        origin, ends = np.array(scan.pose[:2]), hit_ends(scan)
        np.add.at(hits, tuple(((ends - low) / CELL_M).astype(int).T), 1.0)
        reach_m = np.linalg.norm(ends - origin, axis=1)
        for step_m in np.arange(0.5 * CELL_M, reach_m.max(initial=0.0) - CELL_M, CELL_M):
            far = reach_m > step_m + CELL_M
            at = origin + (ends - origin)[far] * (step_m / reach_m[far])[:, None]
            np.add.at(passes, tuple(((at - low) / CELL_M).astype(int).T), 1.0)
    return [hits, passes]


def surroundings(scans: list[Scan], points: np.ndarray) -> np.ndarray:
    """Counts smoothed over some widths, and distances to training hits, as logarithms."""
    hits = np.concatenate([hit_ends(scan) for scan in scans])
    everything = np.concatenate([hits, points, [scan.pose[:2] for scan in scans]])
    low = everything.min(axis=0) - 1.0
    shape = tuple(np.ceil((everything.max(axis=0) + 1.0 - low) / CELL_M).astype(int))
    at = ((points - low) / CELL_M - 0.5).T
    columns = [
        np.log(1e-3 + map_coordinates(gaussian_filter(count, width / CELL_M), at, order=1))
        for count in counts(scans, low, shape)
        for width in WIDTHS_M
    ]
    distance_m, _ = cKDTree(hits).query(points, k=list(NEAREST))
    return np.column_stack([*columns, np.log(distance_m + 0.1 * CELL_M)])


def taught(features: np.ndarray, occupied: np.ndarray, teaches: np.ndarray) -> np.ndarray:
    ensemble = pytest.importorskip("sklearn.ensemble")
    trees = ensemble.HistGradientBoostingClassifier(
        max_iter=200, learning_rate=0.05, max_leaf_nodes=16, min_samples_leaf=200,
        l2_regularization=5.0, early_stopping=False,
    )  # fmt: skip
    trees.fit(features[teaches], occupied[teaches])
    return np.asarray(trees.predict_proba(features[~teaches])[:, 1])


def linked(features: np.ndarray, occupied: np.ndarray, teaches: np.ndarray) -> np.ndarray:
    link = fit(*features[teaches].T, occupied[teaches])
    return link.probability(*(np.ascontiguousarray(c) for c in features[~teaches].T))


@pytest.mark.benchmark
@pytest.mark.timeout(1800)
@pytest.mark.parametrize("log", ["intel", "fr101", "aces", "fr079"])
def test_what_is_left_to_gain(log: str) -> None:
    training, held_out = split(real_log(log))
    tests = [labelled_points([scan], seed=i, keep=None) for i, scan in enumerate(held_out)]
    points = np.concatenate([test.points for test in tests])
    occupied = np.concatenate([test.occupied for test in tests])
    scan_of = np.repeat(np.arange(len(tests)), [len(test) for test in tests])
    odd = (scan_of * BLOCKS // len(tests)) % 2 == 1
    for share in SHARES:
        scans = thin(training, share)
        mapper = Mapper()
        for scan in scans:
            mapper.update(scan)
        snapshot = mapper.train()
        few = heard(snapshot, points)
        many = np.column_stack([few, surroundings(scans, points)])
        as_is = negative_log_likelihood(snapshot.query(points).occupancy, occupied)
        line = f"{log:6} {share!s:>5}  map {as_is:.4f}"
        for name, learn, features in (
            ("its link", linked, few), ("trees", taught, few), ("trees, all", taught, many),
        ):  # fmt: skip
            p = np.empty(len(points))
            for teaches in (odd, ~odd):
                p[~teaches] = learn(features, occupied, teaches)
            line += f"  {name} {negative_log_likelihood(p, occupied):.4f}"
        print(f"\n{line}", end="", flush=True)
