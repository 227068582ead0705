"""Scans of every kind become evidence, in any order, and none is half absorbed."""

from dataclasses import replace

import numpy as np
import pytest

from gpom_core.clusters import new_clusters
from gpom_core.config import MapConfig
from gpom_core.errors import InvalidScanError
from gpom_core.evidence import Evidence, UpdateReport
from gpom_core.kernels import gram
from gpom_core.rows import BOX, NONE, POINT, new_rows
from gpom_core.scan import Pose2D
from gpom_core.shapes import Kind
from gpom_core.sight import new_sight
from gpom_core.tiles import new_tiles
from tests.gpom_core.synthetic import assert_consistent, evidence_by_key, look, scan_of, tour

MODES = ["areas", "segments"]


def evidence_of(*scans: object, **settings: object) -> Evidence:
    evidence = Evidence(MapConfig(**settings))  # type: ignore[arg-type]
    for scan in scans:
        evidence.add(scan)  # type: ignore[arg-type]
    return evidence


def of_kind(evidence: Evidence, kind: int) -> np.ndarray:
    return np.flatnonzero(evidence.rows.kind[: evidence.observation_count] == kind)


def assert_same_shape(a: np.ndarray, b: np.ndarray, tolerance_m: float) -> None:
    """Ends within a tolerance, whichever comes first."""
    assert min(abs(a - b).max(), abs(a[::-1] - b).max()) <= tolerance_m


def state(evidence: Evidence) -> tuple[bytes, ...]:
    """All that the evidence holds, row by row and cluster by cluster."""
    n, c = evidence.observation_count, int(evidence.clusters.size[0])
    rows = [getattr(evidence.rows, name)[:n].tobytes() for name in evidence.rows._fields[1:-1]]
    clusters = [getattr(evidence.clusters, f)[:c].tobytes() for f in evidence.clusters._fields[:-1]]
    return (*rows, *clusters)


@pytest.mark.parametrize("mode", MODES)
def test_a_scan_of_nothing_but_invalid_beams_says_nothing(mode: str) -> None:
    nothing = scan_of([np.nan, -np.inf, 0.01, 9.0, np.nan])  # too near and too far are invalid
    evidence = Evidence(MapConfig(free_evidence=mode))
    assert evidence.add(nothing) == UpdateReport(hits=0, new_observations=0)
    assert evidence.observation_count == 0
    assert evidence.clusters.size[0] == 0
    assert len(evidence.dirty()) == 0


@pytest.mark.parametrize("mode", MODES)
def test_a_single_hit_makes_a_cluster_with_its_beam(mode: str) -> None:
    evidence = evidence_of(scan_of([1.52], first=0.3, step=0.01), free_evidence=mode)
    assert np.count_nonzero(evidence.clusters.rows) == 1
    (hit,) = of_kind(evidence, POINT)
    end = 1.52 * np.array([np.cos(0.3), np.sin(0.3)])
    np.testing.assert_allclose(evidence.rows.geometry[hit], [end, end], rtol=1e-6)
    assert evidence.observation_count > 3
    np.testing.assert_allclose(evidence.take(0)[1].line, [end, end], rtol=1e-6)
    assert_consistent(evidence)


@pytest.mark.parametrize("mode", MODES)
def test_a_scan_without_any_return_is_all_free(mode: str) -> None:
    evidence = evidence_of(scan_of([np.inf] * 12, 1.0, 2.0, range_max=3.0), free_evidence=mode)
    assert len(of_kind(evidence, POINT)) == 0
    assert np.count_nonzero(evidence.clusters.rows) == 1
    ends = evidence.rows.geometry[: evidence.observation_count]
    assert ends.max() == pytest.approx(5.0, abs=0.11)
    assert evidence.take(0)[1].line.tolist() == [[1.0, 2.0], [1.0, 2.0]]
    observations = evidence.take(0)[1].observations()
    assert (observations.targets == -1.0).all()
    assert_consistent(evidence)


def test_hits_beyond_the_range_of_the_map_are_free_up_to_there() -> None:
    evidence = evidence_of(scan_of([7.0], first=0.0, step=0.01), max_range_m=4.0)
    assert len(of_kind(evidence, POINT)) == 0
    boxes = of_kind(evidence, BOX)
    assert evidence.rows.geometry[boxes].max() == pytest.approx(4.0, abs=0.11)
    assert evidence.rows.count[boxes].sum() == pytest.approx(40.0)


def test_beams_are_free_no_farther_than_the_scanner_sees() -> None:
    evidence = evidence_of(scan_of([np.inf], first=0.0, step=0.01, range_max=2.0))
    assert evidence.rows.count[of_kind(evidence, BOX)].sum() == pytest.approx(20.0)


def cramped(config: MapConfig) -> Evidence:
    """With room for next to nothing: arrays grow in the middle of scans."""
    evidence = Evidence(config)
    evidence.rows, evidence.tiles = new_rows(1), new_tiles(1)
    evidence.clusters, evidence._sight = new_clusters(1), new_sight(1, 1)
    return evidence


@pytest.mark.parametrize("mode", MODES)
def test_arrays_that_grow_in_the_middle_of_a_scan_change_nothing(mode: str) -> None:
    config = MapConfig(free_evidence=mode)
    roomy, tight = Evidence(config), cramped(config)
    for scan in [scan_of([np.inf] * 9, 2.0, 1.0), *tour(12)]:  # open space that walls come near to
        assert roomy.add(scan) == tight.add(scan)
    assert state(roomy) == state(tight)
    assert_consistent(tight)


def test_a_scan_given_up_for_want_of_memory_leaves_nothing_to_the_next(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    first, second = tour(2)
    evidence = cramped(MapConfig())
    prepare, turns = evidence._prepare, []

    def refuse(beams: int) -> None:
        turns.append(beams)
        if len(turns) == 6:  # tiles were walked, and some of them counted
            raise MemoryError
        prepare(beams)

    monkeypatch.setattr(evidence, "_prepare", refuse)
    with pytest.raises(MemoryError):
        evidence.add(first)
    monkeypatch.undo()
    assert (evidence._sight.last != NONE).any()

    def length(evidence: Evidence) -> float:
        return float(evidence.rows.count[of_kind(evidence, BOX)].sum())

    before = length(evidence)
    evidence.add(second)
    assert length(evidence) - before == pytest.approx(length(evidence_of(second)), rel=1e-9)


def test_beams_longer_than_a_window_are_counted_whole() -> None:
    beams = scan_of([np.inf] * 3, 0.03, 0.04, first=0.3, step=1.9, range_max=260.0)
    evidence = evidence_of(beams, max_range_m=250.0)
    boxes = of_kind(evidence, BOX)
    assert evidence.rows.count[boxes].sum() == pytest.approx(7500.0)
    assert_consistent(evidence)


def test_a_hit_nearer_than_the_margin_has_no_free_part() -> None:
    evidence = evidence_of(scan_of([0.08], first=0.0, step=0.01))
    assert evidence.rows.kind[: evidence.observation_count].tolist() == [POINT]


@pytest.mark.parametrize("mode", MODES)
def test_a_scanner_mounted_upside_down_sees_the_same(mode: str) -> None:
    scan = look(0.3, -0.2, 0.4)
    other = replace(
        scan,
        ranges_m=scan.ranges_m[::-1].copy(),
        angle_min_rad=scan.angle_min_rad + scan.angle_increment_rad * (len(scan.ranges_m) - 1),
        angle_increment_rad=-scan.angle_increment_rad,
    )
    a, b = (evidence_by_key(evidence_of(s, free_evidence=mode)) for s in (scan, other))
    assert a.keys() == b.keys()
    for key, (count, geometry) in a.items():
        assert b[key][0] == pytest.approx(count, rel=1e-6)
        assert_same_shape(b[key][1], geometry, 1e-6)


@pytest.mark.parametrize("mode", MODES)
def test_the_order_of_scans_does_not_change_what_is_known(mode: str) -> None:
    scans = tour(8)
    a = evidence_by_key(evidence_of(*scans, free_evidence=mode))
    b = evidence_by_key(evidence_of(*scans[::-1], free_evidence=mode))
    assert a.keys() == b.keys()
    for key, (count, geometry) in a.items():
        assert b[key][0] == pytest.approx(count, rel=1e-9)
        assert_same_shape(b[key][1], geometry, 1e-9)


@pytest.mark.parametrize("mode", MODES)
def test_the_same_scans_give_the_same_evidence_bit_by_bit(mode: str) -> None:
    scans = tour(6)
    assert state(evidence_of(*scans, free_evidence=mode)) == state(
        evidence_of(*scans, free_evidence=mode)
    )


@pytest.mark.parametrize("x", [1e7, -1e7])
def test_a_scan_off_the_lattice_is_refused_and_changes_nothing(x: float) -> None:
    evidence = evidence_of(*tour(3), hit_cell_m=0.02)
    before = state(evidence)
    with pytest.raises(InvalidScanError, match="farther from the origin") as refused:
        evidence.add(replace(look(0.0, 0.0), pose=Pose2D(0.0, x, 0.0)))
    assert refused.value.reason == "pose_out_of_range"
    assert state(evidence) == before


def test_silent_beams_follow_the_most_similar_beam_that_returned() -> None:
    ranges = np.full(120, np.inf)
    ranges[20:32] = ranges[46:50] = ranges[90:98] = 4.03
    scan = scan_of(ranges, range_max=6.0)
    config = MapConfig(free_evidence="segments")
    evidence = evidence_of(scan, free_evidence="segments")
    ranges = np.where(np.isinf(scan.ranges_m), 6.0, scan.ranges_m).astype(np.float64)
    angle = scan.beam_angles_rad()
    ends = ranges[:, None] * np.column_stack([np.cos(angle), np.sin(angle)])
    back, silent = np.flatnonzero(scan.hits()), np.flatnonzero(scan.no_returns())
    shapes = np.stack([np.zeros_like(ends), ends], axis=1)
    k = gram(np.full(len(ends), Kind.SEGMENT, np.uint8), shapes, config.length_scale_m)
    like = back[np.argmax(k[np.ix_(silent, back)], axis=1)]
    rows = evidence.rows
    segments = np.flatnonzero(rows.kind[: evidence.observation_count] == Kind.SEGMENT)
    hits = of_kind(evidence, POINT)
    for beam, other in zip(silent, like, strict=True):
        hit = hits[np.linalg.norm(rows.geometry[hits, 0] - ends[other], axis=1).argmin()]
        end = segments[np.linalg.norm(rows.geometry[segments] - ends[beam], axis=2).min(1).argmin()]
        assert rows.owner[end] == rows.owner[hit]


def test_seeing_the_same_again_founds_no_clusters() -> None:
    scans = [*tour(8, noise=0.03), scan_of([np.inf] * 9, 0.1, 0.1)]
    evidence = evidence_of(*scans, *scans)
    before = int(evidence.clusters.size[0])
    for scan in scans * 3:
        assert evidence.add(scan).new_observations == 0
    assert evidence.clusters.size[0] == before


def test_clusters_are_dirty_when_they_have_grown_and_clean_when_taken() -> None:
    evidence = evidence_of(look(0.0, 0.0))
    dirty = evidence.dirty().tolist()
    assert sorted(dirty) == np.flatnonzero(evidence.clusters.rows).tolist()
    change = (evidence.clusters.fresh + evidence.clusters.gain)[dirty].tolist()
    assert change == sorted(change, reverse=True)
    revision, seen = evidence.take(dirty[0])
    assert revision == 1
    assert len(seen.observations()) > 0
    assert dirty[0] not in evidence.dirty()
    assert len(evidence.dirty()) == len(dirty) - 1


def test_looking_on_makes_clusters_dirty_a_bounded_number_of_times() -> None:
    evidence = evidence_of(look(0.0, 0.0), retrain_gain=0.2, hit_cap=10.0, free_cap=10.0)
    taken = []
    for i in range(150):
        for c in evidence.dirty().tolist():
            evidence.take(c)
            taken.append((i, c))
        evidence.add(look(0.0, 0.0))
    # Where nothing contradicts, the shifts of a place add up to less than one; to two elsewhere.
    _, times = np.unique([c for _, c in taken], return_counts=True)
    assert times.max() <= 1 + 2.0 / 0.2
    assert max(i for i, _ in taken) < 100


def test_cells_that_are_grazed_are_evidence_but_no_news() -> None:
    angles = -0.2 + 0.05 * np.arange(9)
    evidence = evidence_of(
        scan_of(2.03 / np.cos(angles), 0.0, -0.001, first=-0.2, step=0.05), hit_margin_m=0.05
    )
    for cluster in evidence.dirty().tolist():
        evidence.take(cluster)
    before = evidence.observation_count
    # Hits in cells that are known to be a surface; beams that end 2 cm into cells never crossed.
    evidence.add(scan_of(2.07 / np.cos(angles), 0.0, -0.001, first=-0.2, step=0.05))
    assert evidence.observation_count > before
    assert not evidence.clusters.fresh.any()
    assert evidence.clusters.gain.any()


def test_the_line_of_a_cluster_runs_along_its_hits() -> None:
    evidence = evidence_of(look(0.0, 0.0, walls=[((-1.0, 0.5), (1.0, 1.0))], beams=720))
    (cluster,) = np.flatnonzero(evidence.clusters.moments[:, 0])
    ends = evidence.take(int(cluster))[1].line
    if ends[0, 0] > ends[1, 0]:
        ends = ends[::-1]
    np.testing.assert_allclose(ends, [(-1.0, 0.5), (1.0, 1.0)], atol=0.05)
