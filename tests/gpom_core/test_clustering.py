"""Batch clusterings: one contract for all, and what sets line tracking apart."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from gpom_core.clustering import DirichletProcess, LineTracking, OneCluster, hits_of
from gpom_core.scan import Pose2D, Scan

CLUSTERINGS = [OneCluster(), DirichletProcess(sweeps=20), LineTracking()]


def look_at_corner(x: float, y: float, yaw: float, beams: int = 17) -> Scan:
    """A scan of two walls, x = 5 and y = 5, that meet in a corner."""
    angle = yaw - np.pi / 2 + np.pi / (beams - 1) * np.arange(beams)
    with np.errstate(divide="ignore"):
        to_x, to_y = (5.0 - x) / np.cos(angle), (5.0 - y) / np.sin(angle)
    ranges = np.minimum(np.where(to_x > 0, to_x, np.inf), np.where(to_y > 0, to_y, np.inf))
    ranges[ranges > 8.0] = np.inf
    return Scan(Pose2D(x, y, yaw), ranges.astype(np.float32), -np.pi / 2, np.pi / (beams - 1),
                0.05, 8.0)  # fmt: skip


def corner() -> list[Scan]:
    return [look_at_corner(t, 0.4 * t, 0.6 + 0.1 * t) for t in np.linspace(0.0, 3.0, 7)]


@pytest.mark.parametrize("clustering", CLUSTERINGS, ids=lambda c: type(c).__name__)
class TestEveryClustering:
    def test_numbers_every_hit_without_gaps(self, clustering):
        labels = clustering(corner())
        assert labels.shape == (len(hits_of(corner())),)
        assert set(labels.tolist()) == set(range(labels.max() + 1))

    def test_repeats_itself(self, clustering):
        assert np.array_equal(clustering(corner()), clustering(corner()))

    def test_takes_no_scans_and_scans_without_hits(self, clustering):
        blind = Scan(Pose2D(0, 0, 0), np.full(3, np.inf, np.float32), 0.0, 0.1, 0.05, 8.0)
        assert len(clustering([])) == 0
        assert len(clustering([blind])) == 0

    def test_takes_a_single_hit(self, clustering):
        one = Scan(Pose2D(0, 0, 0), np.array([np.inf, 2.0], np.float32), 0.0, 0.1, 0.05, 8.0)
        assert clustering([one]).tolist() == [0]


def test_line_tracking_never_mixes_the_walls_of_a_corner():
    points, labels = hits_of(corner()), LineTracking(least_hits=1)(corner())
    for k in range(labels.max() + 1):
        off_m = np.abs(points[labels == k] - 5.0).max(axis=0)
        assert off_m.min() <= 2 * LineTracking().tolerance_m


@settings(max_examples=10)
@given(st.floats(0.5, 4.0))
def test_a_long_line_becomes_as_many_parts_as_its_length_needs(longest_m):
    points, labels = hits_of(corner()), LineTracking(longest_m=longest_m)(corner())
    whole = LineTracking()(corner())
    assert labels.max() >= whole.max()
    for k in range(whole.max() + 1):
        extent = np.ptp(points[whole == k], axis=0).max()
        hits = np.count_nonzero(whole == k)
        needed = max(1, np.ceil(extent / longest_m - 1e-6))
        assert abs(len(np.unique(labels[whole == k])) - min(needed, hits)) <= 1


def test_small_groups_join_their_nearest_line():
    labels = LineTracking(least_hits=4)(corner())
    assert np.bincount(labels).min() >= 4
