"""Beams into rows: what is counted where, how often, and whose it is."""

import numpy as np
import pytest

from gpom_core.config import MapConfig
from gpom_core.evidence import Evidence
from gpom_core.rows import BOX, POINT, SEGMENT
from tests.gpom_core.synthetic import assert_consistent, look, scan_of, tour

CELL_M = MapConfig().cell_m


def evidence_of(*scans: object, **settings: object) -> Evidence:
    evidence = Evidence(MapConfig(**settings))  # type: ignore[arg-type]
    for scan in scans:
        evidence.add(scan)  # type: ignore[arg-type]
    return evidence


def rows_of(evidence: Evidence, kind: int) -> np.ndarray:
    return np.flatnonzero(evidence.rows.kind[: evidence.observation_count] == kind)


def one_beam(x: float, y: float, angle: float, length: float) -> Evidence:
    return evidence_of(scan_of([length], x, y, first=angle, step=0.01), coarse_levels=0)


@pytest.mark.parametrize("angle", [0.0, 0.4, np.pi / 4, np.pi / 2, 2.0, np.pi, -2.7, -np.pi / 2])
@pytest.mark.parametrize("origin", [(0.0, 0.0), (0.33, -0.71), (-5.0, 2.05)])
def test_a_beam_counts_in_the_cells_it_crosses_by_length(
    origin: tuple[float, float], angle: float
) -> None:
    evidence = one_beam(*origin, angle, 3.0)
    boxes = rows_of(evidence, BOX)
    geometry, count = evidence.rows.geometry[boxes], evidence.rows.count[boxes]
    # By sampling: which cell each step of the free part lies in.
    free_m, steps = 3.0 - MapConfig().hit_margin_m, 100_000
    t = (np.arange(steps) + 0.5) * free_m / steps
    at = np.array(origin) + t[:, None] * (np.cos(angle), np.sin(angle))
    cells, times = np.unique(np.floor(at / CELL_M).astype(int), axis=0, return_counts=True)
    expected = {tuple(c): n * free_m / steps / CELL_M for c, n in zip(cells, times, strict=True)}
    got = {
        tuple(np.round(g[0] / CELL_M).astype(int)): c for g, c in zip(geometry, count, strict=True)
    }
    # Along an edge of the lattice rounding says which side the beam is on.
    if not (angle % (np.pi / 2) == 0.0 and origin != (0.33, -0.71)):
        for cell in expected | got:
            assert got.get(cell, 0.0) == pytest.approx(expected.get(cell, 0.0), abs=1e-3)
    assert count.sum() == pytest.approx(free_m / CELL_M)
    np.testing.assert_allclose(geometry[:, 1] - geometry[:, 0], CELL_M)


def test_all_length_that_is_free_is_counted_and_nothing_else() -> None:
    scans = tour(6)
    config = MapConfig()
    free_m = sum(
        np.where(np.isinf(r), s.range_max_m, r - config.hit_margin_m).clip(0.0, None).sum()
        for s in scans
        for r in [s.ranges_m.astype(np.float64)]
    )
    areas, segments = evidence_of(*scans), evidence_of(*scans, free_evidence="segments")
    for evidence, kind, unit_m in [(areas, BOX, CELL_M), (segments, SEGMENT, config.segment_m)]:
        counted = evidence.rows.count[rows_of(evidence, kind)].sum() * unit_m
        assert counted == pytest.approx(free_m, rel=1e-9)


def test_hits_of_one_cell_are_one_row_at_their_mean() -> None:
    ranges = [2.01, 2.02, 2.04]
    evidence = evidence_of(*[scan_of([r], 0.0, 0.01, first=0.0, step=0.01) for r in ranges])
    (row,) = rows_of(evidence, POINT)
    assert evidence.rows.count[row] == 3.0
    np.testing.assert_allclose(evidence.rows.geometry[row], [[np.mean(ranges), 0.01]] * 2)


def test_a_place_follows_what_is_seen_once_its_count_is_capped() -> None:
    evidence = Evidence(MapConfig(hit_cap=10.0))
    before, after = (scan_of([r], 0.0, 0.01, first=0.0, step=0.01) for r in (2.01, 2.04))
    for _ in range(200):
        evidence.add(before)
    for _ in range(60):
        evidence.add(after)
    (row,) = rows_of(evidence, POINT)
    assert evidence.rows.count[row] == 260.0
    assert evidence.rows.geometry[row, 0, 0] == pytest.approx(2.04, abs=1e-3)


def test_hits_stay_within_their_cell() -> None:
    evidence = evidence_of(*tour(10, noise=0.03))
    hits = rows_of(evidence, POINT)
    at = evidence.rows.geometry[hits, 0] / MapConfig().hit_cell_m
    keys = evidence.rows.keys[hits, 0]
    cells = np.column_stack([(keys >> 29) & (2**29 - 1), keys & (2**29 - 1)]) - 2**28
    assert (at >= cells - 1e-9).all()
    assert (at <= cells + 1 + 1e-9).all()


def test_free_areas_know_their_nearest_surface_and_belong_to_it() -> None:
    evidence = evidence_of(*tour(10), max_length_m=100.0)  # splitting cuts across
    config, rows = evidence.config, evidence.rows
    hits, boxes = rows_of(evidence, POINT), rows_of(evidence, BOX)
    centre = rows.geometry[boxes].mean(axis=1)
    distance = np.linalg.norm(centre[:, None] - rows.geometry[hits, 0][None], axis=2)
    nearest = distance.min(axis=1)
    known = np.isfinite(rows.near[boxes])
    # A cell of the lattice remembers its first hit, and hits move a little within theirs.
    slack = np.sqrt(2.0) * config.cell_m
    assert (rows.near[boxes][known] >= nearest[known] - slack).all()
    assert (rows.near[boxes][known] <= nearest[known] + slack).all()
    assert (nearest[~known] >= config.near_surface_m - slack).all()
    for b in np.flatnonzero(known):
        close = distance[b] <= nearest[b] + 2.0 * slack
        assert rows.owner[boxes[b]] in rows.owner[hits[close]]


def test_a_nearer_surface_takes_free_areas_over() -> None:
    wall = [((2.03, -3.0), (2.03, 3.0))]
    evidence = evidence_of(look(0.0, 0.0, walls=wall, beams=360))
    boxes = rows_of(evidence, BOX)
    centre = evidence.rows.geometry[boxes].mean(axis=1)
    spot = boxes[np.linalg.norm(centre - (1.35, 0.05), axis=1).argmin()]
    before, near = int(evidence.rows.owner[spot]), float(evidence.rows.near[spot])
    panel = [((1.53, -0.6), (1.53, 0.6))]  # put up later, between the spot and the wall
    evidence.add(look(0.0, 0.0, walls=panel + wall, beams=360))
    hits = rows_of(evidence, POINT)
    new = hits[np.abs(evidence.rows.geometry[hits, 0, 0] - 1.53) < 0.02]
    assert evidence.rows.near[spot] < near
    assert evidence.rows.owner[spot] != before
    assert evidence.rows.owner[spot] in evidence.rows.owner[new]
    assert_consistent(evidence)


def test_segments_are_no_longer_than_asked_and_merge_either_way_round() -> None:
    there = scan_of([3.07], 0.03, 0.04, first=0.3, step=0.01)
    end = np.array([0.03, 0.04]) + 3.07 * np.array([np.cos(0.3), np.sin(0.3)])
    evidence = evidence_of(there, free_evidence="segments", hit_margin_m=0.0)
    rows = evidence.rows
    segments = rows_of(evidence, SEGMENT)
    assert len(segments) == 7
    length = np.linalg.norm(np.diff(rows.geometry[segments], axis=1)[:, 0], axis=1)
    np.testing.assert_allclose(length, 3.07 / 7)
    before = rows.geometry[segments].copy()
    evidence.add(scan_of([3.07], *end, first=0.3 + np.pi, step=0.01))
    assert len(rows_of(evidence, SEGMENT)) == 7
    np.testing.assert_allclose(evidence.rows.geometry[segments], before, atol=1e-6)
    np.testing.assert_allclose(evidence.rows.count[segments], 2.0 * 3.07 / 7 / 0.5, rtol=1e-6)
