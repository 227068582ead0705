"""Laws of evidence, for any scans in any order, with training and splitting in between."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from gpom_core.clusters import length_m
from gpom_core.committee import fuse
from gpom_core.config import MapConfig
from gpom_core.evidence import Evidence
from gpom_core.mapper import Mapper
from gpom_core.rows import POINT
from gpom_core.scan import Pose2D, Scan
from tests.gpom_core.synthetic import (
    assert_consistent,
    evidence_by_key,
    look,
    moved,
    posterior,
    scan_of,
    weighed,
)

MODES = ["areas", "segments"]
ranges = st.one_of(
    st.floats(0.0, 9.0, width=32),
    st.just(np.inf),
    st.sampled_from([np.nan, -np.inf, 0.0, -1.0, 3.0, 100.0]),
)


@st.composite
def any_scans(draw: st.DrawFn) -> Scan:
    """Scans of anything at all, within a few metres, by any scanner."""
    values = draw(st.lists(ranges, min_size=1, max_size=30))
    return scan_of(
        values,
        draw(st.floats(-4.0, 4.0)),
        draw(st.floats(-4.0, 4.0)),
        draw(st.floats(-10.0, 10.0)),
        first=draw(st.floats(-3.2, 3.2)),
        step=draw(st.sampled_from([-0.3, -0.01, 0.01, 0.2])),
        range_max=draw(st.sampled_from([0.5, 4.0, 8.0])),
    )


@st.composite
def room_scans(draw: st.DrawFn) -> Scan:
    """Scans from somewhere in the room, so that evidence meets evidence.

    No beam runs along an edge of the lattice, where rounding says which side it is on.
    """
    return look(
        0.0137 * draw(st.integers(-200, 60)) + 0.0031,
        0.0113 * draw(st.integers(-160, 160)) + 0.0047,
        0.017 * draw(st.integers(-180, 180)) + 0.0053,
        beams=draw(st.sampled_from([5, 24, 60])),
        noise=draw(st.sampled_from([0.0, 0.02, 0.3])),
        seed=draw(st.integers(0, 1000)),
        range_max=draw(st.sampled_from([1.5, 8.0])),
    )


scans = st.lists(any_scans() | room_scans(), min_size=1, max_size=5)


def evidence_of(scans: list[Scan], **kwargs: object) -> Evidence:
    evidence = Evidence(MapConfig(**kwargs))  # type: ignore[arg-type]
    for scan in scans:
        evidence.add(scan)
    return evidence


@pytest.mark.parametrize("mode", MODES)
@given(scans)
@settings(max_examples=40)
def test_every_row_has_one_home_and_no_cluster_is_too_long(mode: str, scans: list[Scan]) -> None:
    evidence = Evidence(MapConfig(free_evidence=mode, max_length_m=1.0))
    for scan in scans:
        report = evidence.add(scan)
        assert report.hits == np.count_nonzero(scan.hits())
        size = int(evidence.clusters.size[0])
        assert all(length_m(evidence.clusters, c) <= 1.0 for c in range(size))
    assert_consistent(evidence)


@pytest.mark.parametrize("mode", MODES)
@given(scans, st.randoms(use_true_random=False))
@settings(max_examples=40)
def test_what_is_known_does_not_depend_on_the_order_of_scans(mode, scans, random) -> None:
    order = list(scans)
    random.shuffle(order)
    a = evidence_by_key(evidence_of(scans, free_evidence=mode))
    b = evidence_by_key(evidence_of(order, free_evidence=mode))
    assert a.keys() == b.keys()
    for key, (count, geometry) in a.items():
        np.testing.assert_allclose(b[key][0], count, rtol=1e-6)
        if mode == "areas":
            np.testing.assert_allclose(b[key][1], geometry, atol=1e-9)


@given(scans)
@settings(max_examples=30)
def test_a_place_counts_each_hit_that_fell_on_it(scans: list[Scan]) -> None:
    evidence = evidence_of(scans)
    rows, n = evidence.rows, evidence.observation_count
    hits = rows.count[:n][rows.kind[:n] == POINT]
    assert hits.sum() == sum(np.count_nonzero(s.hits()) for s in scans)
    assert (hits == np.round(hits)).all()


@given(scans, st.integers(2, 5))
@settings(max_examples=20)
def test_seeing_the_same_n_times_is_counting_n_times(scans: list[Scan], n: int) -> None:
    once, often = evidence_by_key(evidence_of(scans)), evidence_by_key(evidence_of(scans * n))
    assert once.keys() == often.keys()
    for key, (count, geometry) in once.items():
        np.testing.assert_allclose(often[key][0], n * count, rtol=1e-9)
        np.testing.assert_allclose(often[key][1], geometry, atol=1e-9)


@given(
    st.lists(room_scans(), min_size=1, max_size=3), st.integers(-200, 200), st.integers(-200, 200)
)
@settings(max_examples=15)
def test_a_map_moved_by_whole_tiles_is_the_same_map(scans, dx: int, dy: int) -> None:
    shift = np.array([dx, dy]) * 8.0  # of the lattice and of the index
    points = np.random.default_rng(0).uniform((-4.0, -3.0), (4.0, 3.0), (60, 2))
    mappers = Mapper(), Mapper()
    for scan in scans:
        mappers[0].update(scan)
        mappers[1].update(moved(scan, *shift))
    a, b = mappers[0].train().query(points), mappers[1].train().query(points + shift)
    np.testing.assert_allclose(b.occupancy, a.occupancy, atol=2e-3)


@pytest.mark.parametrize("mode", MODES)
@given(scans)
@settings(max_examples=25)
def test_indexed_answers_are_those_of_the_whole_committee(mode: str, scans: list[Scan]) -> None:
    mapper = Mapper(MapConfig(free_evidence=mode, max_observations=80))
    for scan in scans:
        mapper.update(scan)
    snapshot = mapper.train()
    assert_consistent(mapper._evidence)
    points = np.random.default_rng(1).uniform(-6.0, 6.0, (60, 2))
    answer = snapshot.query(points)
    assert (answer.variance <= snapshot.prior_variance).all()
    if not snapshot.members:
        assert (answer.occupancy == 0.5).all()
        return
    opinions = [posterior(m.expert, points) for m in snapshot.members.values()]
    means, variances = (np.array(part) for part in zip(*opinions, strict=True))
    mean, variance = fuse(means, variances, snapshot.prior_variance)
    counts = sum(weighed(m.expert, points) for m in snapshot.members.values())
    exact = snapshot.link.probability(mean, variance / snapshot.prior_variance, *np.log1p(counts))
    assert abs(answer.occupancy - exact).max() < 2e-3


@pytest.mark.parametrize("mode", MODES)
def test_thousands_of_scans_leave_the_lists_whole(mode: str) -> None:
    rng = np.random.default_rng(5)
    config = MapConfig(free_evidence=mode, max_length_m=1.5, max_observations=90, cell_m=0.2)
    mapper = Mapper(config)
    for i in range(1500):
        scan = look(
            rng.uniform(-2.9, 0.9), rng.uniform(-1.9, 1.9), rng.uniform(-3.0, 3.0),
            beams=int(rng.integers(1, 40)), noise=float(rng.choice([0.0, 0.05, 1.0])), seed=i,
            range_max=float(rng.choice([1.0, 8.0])),
        )  # fmt: skip
        if rng.random() < 0.1:
            scan = replace(scan, ranges_m=np.full(len(scan.ranges_m), np.inf, np.float32))
        if rng.random() < 0.1:
            scan = replace(scan, pose=Pose2D(*rng.uniform(-20.0, 20.0, 2), 0.0))
        mapper.update(scan)
        if rng.random() < 0.05:
            jobs = mapper.take_jobs(int(rng.integers(1, 30)))
            assert all(len(job.observations) <= 90 for job in jobs)
            done = [job for job in jobs if rng.random() < 0.7]
            mapper.swap([job.run() for job in done])
            for job in jobs:
                if job not in done:
                    mapper.fail(job)
        if i % 250 == 0:
            assert_consistent(mapper._evidence)
    assert_consistent(mapper._evidence)
    snapshot = mapper.train()
    assert mapper.dirty_count == 0
    clusters = mapper._evidence.clusters
    assert set(snapshot.members) == set(np.flatnonzero(clusters.rows).tolist())
