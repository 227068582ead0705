"""Free space where no surface is near costs what it is worth, and nothing where no beam went."""

from dataclasses import replace

import numpy as np
import pytest

from gpom_core.config import MapConfig
from gpom_core.evidence import Evidence
from gpom_core.image import dump, load
from gpom_core.mapper import Mapper
from gpom_core.rows import BOX
from gpom_core.scan import Pose2D, Scan
from tests.gpom_core.synthetic import assert_consistent, evidence_by_key, look, moved, scan_of

CONFIG = MapConfig()
WALL = [((6.03, -8.0), (6.03, 8.0))]


def yard(beams: int = 360, range_m: float = 30.0) -> Scan:
    """A scan that meets nothing."""
    return scan_of([np.inf] * beams, 0.03, 0.04, 0.001, range_max=range_m)


def evidence_of(*scans: Scan, **settings: object) -> Evidence:
    evidence = Evidence(MapConfig(**settings))  # type: ignore[arg-type]
    for scan in scans:
        evidence.add(scan)
    return evidence


def test_a_scan_without_any_return_is_a_few_thousand_rows_and_no_more_when_repeated() -> None:
    mapper = Mapper()
    mapper.update(yard())
    rows = mapper.observation_count
    assert 2000 < rows < 5000  # a disc of 30 m has 4400 tiles
    taken = [len(job.observations) for job in mapper.take_jobs(10_000)]
    assert sum(taken) <= rows
    experts = len(taken)
    rng = np.random.default_rng(0)
    for dx, dy, turn in rng.normal(0.0, 0.01, (50, 3)):
        mapper.update(replace(yard(), pose=Pose2D(0.03 + dx, 0.04 + dy, turn)))
    assert mapper.observation_count < 1.03 * rows
    assert mapper.expert_count <= experts
    assert_consistent(mapper._evidence)


def test_driving_on_without_any_return_founds_no_expert_a_scan() -> None:
    mapper = Mapper()
    for i in range(40):
        mapper.update(moved(yard(90, 10.0), 0.2 * i, 0.0))
        mapper.take_jobs(1000)
    largest = CONFIG.max_observations
    assert mapper.expert_count <= 6 * mapper.observation_count / largest


def test_nothing_is_free_where_no_beam_went() -> None:
    beams, range_m = 8, 9.0
    scan = yard(beams, range_m)
    mapper = Mapper()
    mapper.update(scan)
    rows = mapper._evidence.rows
    box = rows.geometry[: mapper.observation_count]
    t = np.linspace(0.0, range_m, 3000)[None, :, None]
    angle = scan.beam_angles_rad()
    at = (0.03, 0.04) + t * np.stack([np.cos(angle), np.sin(angle)], -1)[:, None]
    at = at.reshape(-1, 2)
    for low, high in box:  # each holds a part of a beam, and its sides touch it
        inside = at[((at >= low - 0.01) & (at <= high + 0.01)).all(axis=1)]
        np.testing.assert_allclose(inside.min(axis=0), low, atol=CONFIG.cell_m)
        np.testing.assert_allclose(inside.max(axis=0), high, atol=CONFIG.cell_m)
    answer = mapper.train().query(np.array([[7.4, 3.1], [3.1, -7.4], [9.6, 0.04], [0.03, 9.6]]))
    assert not answer.known.any()
    np.testing.assert_allclose(answer.occupancy, 0.5, atol=0.1)


def test_where_beams_went_it_is_free() -> None:
    mapper = Mapper()
    for i in range(5):
        mapper.update(moved(yard(360, 12.0), 0.3 * i, 0.0))
    answer = mapper.train().query(np.random.default_rng(0).uniform(-5.0, 5.0, (200, 2)))
    assert answer.known.all()
    assert answer.occupancy.max() < 0.3


def test_all_length_is_counted() -> None:
    scan = yard()
    rows = evidence_of(scan).rows
    assert rows.count.sum() * CONFIG.cell_m == pytest.approx(360 * 30.0)


@pytest.mark.parametrize("first", ["yard", "wall"])
def test_a_surface_makes_its_surroundings_fine_whenever_it_is_seen(first: str) -> None:
    open_scan = yard(200, 5.5)
    wall = look(0.0, 0.0, walls=WALL, beams=180)
    scans = [open_scan, open_scan, wall] if first == "yard" else [wall, open_scan, open_scan]
    evidence = evidence_of(*scans)
    assert_consistent(evidence)
    assert (evidence.tiles.size[1:] == 0).all()
    rows, n = evidence.rows, evidence.observation_count
    box, hits = rows.geometry[:n][rows.kind[:n] == BOX], rows.geometry[:n][rows.kind[:n] != BOX]
    edge = (box[:, 1] - box[:, 0]).max(axis=1)
    away = np.linalg.norm(box.mean(axis=1)[:, None] - hits[None, :, 0], axis=2).min(axis=1)
    assert (edge[away < CONFIG.near_surface_m] < 1.5 * CONFIG.cell_m).all()
    assert (edge > 4 * CONFIG.cell_m).any()
    fine = evidence_of(*scans, coarse_levels=0)
    cells, whole = evidence_by_key(fine), rows.crossed[:n] > 0
    for row in np.flatnonzero((rows.kind[:n] == BOX) & ~whole):
        count, geometry = cells[int(rows.keys[row, 0]), 0]
        assert rows.count[row] == pytest.approx(count)
        np.testing.assert_array_equal(rows.geometry[row], geometry)
    assert rows.count[:n].sum() == pytest.approx(fine.rows.count[: fine.observation_count].sum())


def test_the_order_of_scans_makes_no_difference() -> None:
    scans = [yard(200, 5.5), look(0.0, 0.0, walls=WALL, beams=180), moved(yard(90, 7.0), 3.0, 3.0)]
    one, other = evidence_by_key(evidence_of(*scans)), evidence_by_key(evidence_of(*scans[::-1]))
    assert one.keys() == other.keys()
    for key, (count, geometry) in one.items():
        assert other[key][0] == pytest.approx(count)
        np.testing.assert_allclose(other[key][1], geometry, atol=1e-9)


def test_an_open_map_goes_on_after_a_restart() -> None:
    scans = [yard(200, 5.5), moved(yard(90, 7.0), 3.0, 3.0), look(0.0, 0.0, walls=WALL, beams=180)]
    straight, restarted = Mapper(), Mapper()
    for mapper in (straight, restarted):
        mapper.update(scans[0])
    restarted = load(dump(restarted), CONFIG)
    for mapper in (straight, restarted):
        for scan in scans[1:]:
            mapper.update(scan)
    one, other = (evidence_by_key(m._evidence) for m in (straight, restarted))
    assert one.keys() == other.keys()
    assert all(other[key][0] == count for key, (count, _) in one.items())


@pytest.mark.parametrize("beams", [4, 8, 16])
def test_beams_along_the_edges_of_tiles_leave_no_row_without_a_beam(beams: int) -> None:
    evidence = evidence_of(scan_of([np.inf] * beams, 0.0, 0.8, range_max=16.0))
    assert (evidence.rows.count[: evidence.observation_count] > 0.0).all()
    assert np.isfinite(evidence.rows.geometry[: evidence.observation_count]).all()
    assert_consistent(evidence)
