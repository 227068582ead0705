"""The batch mixture: beams into clusters, experts into one map, and its calibration."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from gpom_core.beam_calibration import calibrated, leave_one_beam_out
from gpom_core.clustering import LineTracking, OneCluster
from gpom_core.committee import Fusion, fuse
from gpom_core.expert import Hyperparameters, train
from gpom_core.mixture import (
    Cluster,
    Mixture,
    assign_beams,
    beams_of,
    clusters_of,
    is_near,
    predict,
)
from gpom_core.scan import Scan
from gpom_core.shapes import Kind
from tests.gpom_core.test_clustering import corner

SETTINGS = {"length_scale_m": 0.8, "hit_noise_std": 0.1, "free_noise_std": 0.2}
LEARNED = Hyperparameters(0.7, 1.0)


def mixture_of(clusters: list[Cluster], hyperparameters: Hyperparameters = LEARNED) -> Mixture:
    return Mixture(tuple(train(c.observations, hyperparameters) for c in clusters))


@pytest.fixture(scope="module")
def clusters() -> list[Cluster]:
    return clusters_of(corner(), LineTracking(), **SETTINGS)


def somewhere(n: int = 50) -> np.ndarray:
    return np.random.default_rng(0).uniform(-4.0, 6.0, (n, 2))


def test_every_beam_and_hit_is_observed_once(clusters):
    beams = beams_of(corner())
    kinds = np.concatenate([c.observations.kinds for c in clusters])
    assert np.count_nonzero(kinds == Kind.POINT) == beams.returned.sum()
    assert np.count_nonzero(kinds == Kind.SEGMENT) == len(beams.returned)
    beam = np.concatenate([c.beam for c in clusters])
    assert np.bincount(beam).tolist() == (1 + beams.returned).tolist()


def test_no_cluster_has_free_evidence_alone(clusters):
    for cluster in clusters:
        assert set(np.sign(cluster.observations.targets)) == {-1.0, 1.0}


@settings(max_examples=10)
@given(st.floats(0.3, 4.0))
def test_cut_beams_are_short_and_cover_the_whole_beam(segment_m):
    (whole,) = clusters_of(corner(), OneCluster(), **SETTINGS)
    (cut,) = clusters_of(corner(), OneCluster(), **SETTINGS, segment_m=segment_m)

    def lengths(cluster: Cluster) -> np.ndarray:
        spans = np.diff(cluster.observations.geometry, axis=1)[:, 0]
        return np.bincount(cluster.beam, np.hypot(*spans.T))

    pieces = cut.observations.geometry[:, 1] - cut.observations.geometry[:, 0]
    assert np.hypot(*pieces.T).max() <= segment_m + 1e-9
    assert np.allclose(lengths(cut), lengths(whole))


def test_a_beam_without_return_goes_with_its_neighbour():
    beams = beams_of(corner()[:1])
    hits = np.arange(np.count_nonzero(beams.returned))
    labels = assign_beams(beams, hits, 0.8)
    assert np.array_equal(labels[beams.returned], hits)
    returned = np.flatnonzero(beams.returned)
    for silent in np.flatnonzero(~beams.returned):
        # of one pose, the most similar beam is a neighbour in angle
        nearest = np.abs(returned - silent).min()
        assert abs(returned[labels[silent]] - silent) == nearest


def test_beams_without_any_return_are_one_cluster():
    blind = [replace(s, ranges_m=np.full(17, np.inf, np.float32)) for s in corner()]
    (only,) = clusters_of(blind, LineTracking(), **SETTINGS)
    assert len(only.observations) == 7 * 17


@pytest.mark.parametrize("fusion", list(Fusion))
def test_fuses_as_the_committee_does(clusters, fusion):
    mixture = mixture_of(clusters).with_fusion(fusion)
    opinions = [predict(expert, somewhere()) for expert in mixture.experts]
    mean, variance = fuse(*(np.array(part) for part in zip(*opinions, strict=True)), 1.0, fusion)
    # experts out of reach are left out: their share is below 1e-3
    found_mean, found_variance = mixture.latent(somewhere())
    assert np.allclose(found_mean, mean, atol=5e-3)
    assert np.allclose(found_variance, variance, atol=5e-3)


def test_one_cluster_is_a_single_process():
    (cluster,) = clusters_of(corner(), OneCluster(), **SETTINGS)
    mixture = mixture_of([cluster])
    expert = train(cluster.observations, LEARNED)
    near = is_near(somewhere(), cluster.observations.kinds, cluster.observations.geometry, 1.0)
    mean, variance = predict(expert, somewhere()[near])
    found = mixture.latent(somewhere()[near])
    assert np.allclose(found, (mean, variance))


@given(st.integers(0, 1000), st.sampled_from(list(Kind)))
def test_near_means_within_the_distance_of_the_shape(seed, kind):
    rng = np.random.default_rng(seed)
    geometry = np.sort(rng.normal(size=(1, 2, 2)), axis=1)
    if kind == Kind.POINT:
        geometry[0, 1] = geometry[0, 0]
    points = 2.0 * rng.normal(size=(40, 2))
    share = np.linspace(0.0, 1.0, 2001)[:, None]
    inside = geometry[0, 0] + share * (geometry[0, 1] - geometry[0, 0])
    distance = np.hypot(*(points[:, None] - inside).transpose(2, 0, 1)).min(axis=1)
    if kind == Kind.BOX:
        beyond = np.maximum(np.maximum(geometry[0, 0] - points, points - geometry[0, 1]), 0.0)
        distance = np.hypot(*beyond.T)
    clear = np.abs(distance - 0.7) > 1e-2
    near = is_near(points, np.array([kind], np.uint8), geometry, 0.7)
    assert np.array_equal(near[clear], distance[clear] < 0.7)


def without(cluster: Cluster, beam: int) -> Cluster:
    o, kept = cluster.observations, cluster.beam != beam
    names = ("kinds", "geometry", "targets", "noise_variance", "count")
    return Cluster(replace(o, **{n: getattr(o, n)[kept] for n in names}), cluster.beam[kept])


@pytest.mark.parametrize("fusion", list(Fusion))
def test_leaving_a_beam_out_is_training_without_it(clusters, fusion):
    beams = beams_of(corner())
    mixture = mixture_of(clusters).with_fusion(fusion)
    mean, variance, truth = leave_one_beam_out(mixture, clusters, beams)
    own = np.unique(clusters[0].beam)
    hit = own[beams.returned[own]]
    for j in (0, len(hit) - 1):
        rest = [without(clusters[0], hit[j]), *clusters[1:]]
        refitted = mixture_of(rest).with_fusion(fusion)
        expected = refitted.latent(beams.end[hit[j]][None])
        assert truth[j]
        assert mean[j] == pytest.approx(expected[0][0], abs=5e-3)
        assert variance[j] == pytest.approx(expected[1][0], abs=5e-3)


def test_calibration_improves_the_likelihood_of_what_was_left_out(clusters):
    beams = beams_of(corner())
    before = mixture_of(clusters)
    after = calibrated(before, clusters, beams)
    mean, variance, truth = leave_one_beam_out(before, clusters, beams)

    def loss(mixture: Mixture) -> float:
        p = mixture.calibration.probability(mean, variance)
        return -float(np.log(np.where(truth, p, 1.0 - p)).mean())

    assert loss(after) < loss(before)
    assert after.calibration.offset == 0.0
    assert after.occupancy(np.array([[100.0, 100.0]])) == pytest.approx(0.5)


def test_scans_of_one_beam_each():
    one = Scan(corner()[0].pose, np.array([2.0], np.float32), 0.0, 0.0, 0.05, 8.0)
    (cluster,) = clusters_of([one], LineTracking(), **SETTINGS)
    assert len(cluster.observations) == 2
