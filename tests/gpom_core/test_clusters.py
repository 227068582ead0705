"""Clusters: which one a run of hits joins, how long they are, and how they are split."""

import numpy as np
import pytest

from gpom_core.clusters import length_m, shift
from gpom_core.config import MapConfig
from gpom_core.evidence import Evidence
from gpom_core.rows import POINT
from tests.gpom_core.synthetic import assert_consistent, look, tour

LONG = [((-9.03, 2.03), (9.03, 2.03))]


def hits_by_cluster(evidence: Evidence) -> dict[int, np.ndarray]:
    rows = evidence.rows
    hits = np.flatnonzero(rows.kind[: evidence.observation_count] == POINT)
    owner = rows.owner[hits]
    return {int(c): rows.geometry[hits[owner == c], 0] for c in np.unique(owner)}


def test_a_wall_seen_again_stays_one_cluster() -> None:
    evidence = Evidence(MapConfig())
    wall = [((-1.03, 1.53), (1.03, 1.53))]
    for i in range(5):
        evidence.add(look(-0.2 + 0.1 * i, 0.0, 0.02 * i, walls=wall, beams=360, noise=0.01, seed=i))
    assert len(hits_by_cluster(evidence)) == 1


def test_two_walls_that_meet_are_two_clusters() -> None:
    evidence = Evidence(MapConfig())
    walls = [((-1.03, 1.03), (1.03, 1.03)), ((1.03, 1.03), (1.03, -1.03))]
    for i in range(5):
        evidence.add(look(-0.2 + 0.1 * i, 0.0, 0.02 * i, walls=walls, beams=360, seed=i))
    groups = hits_by_cluster(evidence)
    large = [xy for xy in groups.values() if len(xy) > 5]
    assert len(large) == 2
    for xy in large:  # flat along one of the axes
        assert np.sort(xy.std(axis=0))[0] < 0.05


def test_parallel_walls_farther_apart_than_the_tolerance_stay_apart() -> None:
    evidence = Evidence(MapConfig())
    evidence.add(look(0.0, 0.0, walls=[((-1.0, 1.03), (1.0, 1.03))], beams=360))
    evidence.add(look(0.0, 0.0, walls=[((-1.0, 1.43), (1.0, 1.43))], beams=360))
    for xy in hits_by_cluster(evidence).values():
        assert np.ptp(xy[:, 1]) < 0.3


def test_the_length_of_a_wall_is_measured_from_the_spread_of_its_hits() -> None:
    evidence = Evidence(MapConfig(max_length_m=20.0))
    evidence.add(look(0.0, 0.0, walls=[((-1.03, 0.73), (1.03, 0.73))], beams=1440))
    (cluster,) = hits_by_cluster(evidence)
    assert length_m(evidence.clusters, cluster) == pytest.approx(2.06, rel=0.1)


def test_a_cluster_without_hits_has_no_length() -> None:
    evidence = Evidence(MapConfig())
    assert length_m(evidence.clusters, 0) == 0.0


def test_a_long_wall_is_split_until_no_part_is_too_long() -> None:
    evidence = Evidence(MapConfig(max_length_m=2.0))
    for i in range(12):
        evidence.add(look(-6.0 + i, 0.0, walls=LONG, beams=360, noise=0.01, seed=i))
        size = int(evidence.clusters.size[0])
        assert max(length_m(evidence.clusters, c) for c in range(size)) <= 2.0
    assert len(hits_by_cluster(evidence)) >= 6
    assert_consistent(evidence)


def test_halves_lie_on_either_side_of_the_cut() -> None:
    evidence = Evidence(MapConfig(max_length_m=20.0))
    evidence.add(look(0.0, 0.0, walls=[((-1.03, 0.73), (1.03, 0.73))], beams=1440))
    ((cluster, whole),) = hits_by_cluster(evidence).items()
    evidence.split(cluster, by_hits=True)
    left, right = sorted(hits_by_cluster(evidence).values(), key=lambda xy: xy[0, 0])
    assert left[:, 0].max() < whole[:, 0].mean() < right[:, 0].min()


@pytest.mark.parametrize("by_hits", [True, False])
def test_splitting_loses_no_evidence_and_makes_both_halves_dirty(by_hits: bool) -> None:
    evidence = Evidence(MapConfig())
    for scan in tour(4):
        evidence.add(scan)
    clusters = evidence.clusters
    cluster = int(np.argmax(clusters.moments[: clusters.size[0], 0]))
    rows_before, hits_before = int(clusters.rows[cluster]), clusters.moments[cluster, 0]
    for c in range(int(clusters.size[0])):
        evidence.take(c)
    assert len(evidence.dirty()) == 0
    kept, new = evidence.split(cluster, by_hits=by_hits)
    assert kept == cluster
    assert sorted(evidence.dirty().tolist()) == sorted([cluster, new])
    after = evidence.clusters
    assert after.rows[cluster] + after.rows[new] == rows_before
    assert min(after.rows[cluster], after.rows[new]) > 0
    assert after.moments[cluster, 0] + after.moments[new, 0] == hits_before
    assert_consistent(evidence)


def test_what_is_in_one_place_cannot_be_split() -> None:
    evidence = Evidence(MapConfig(hit_margin_m=1.0))
    evidence.add(look(0.0, 0.0, walls=[((0.53, -0.001), (0.53, 0.001))], beams=360))
    size = int(evidence.clusters.size[0])
    assert evidence.split(0, by_hits=True) == []
    assert evidence.clusters.size[0] == size


@pytest.mark.parametrize("count", [0.0, 0.3, 4.0, 90.0])
@pytest.mark.parametrize("added", [0.05, 1.0, 7.0])
@pytest.mark.parametrize("against", [0.0, 2.0, 50.0])
def test_a_shift_is_how_far_the_mean_of_a_place_moves(
    count: float, added: float, against: float
) -> None:
    def mean(n: float) -> float:
        return (n - against) / (n + against + 1.0)

    assert shift(count, added, against) == pytest.approx(mean(count + added) - mean(count))
