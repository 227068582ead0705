"""Calibration leaves scans out: what is asked is what a map without the scan would answer."""

import numpy as np
import pytest

from gpom_core.config import MapConfig
from gpom_core.link import Link
from gpom_core.mapper import Mapper
from gpom_core.recalibration import _SEED, BEAMS, SCANS, CalibrationJob, _questions, leave_scans_out
from gpom_core.scan import Scan
from gpom_core.snapshot import Snapshot
from tests.gpom_core.synthetic import look, scan_of, tour

AREAS = MapConfig()
SEGMENTS = MapConfig(free_evidence="segments")


def mapped(scans: list[Scan], config: MapConfig = AREAS) -> Snapshot:
    mapper = Mapper(config)
    for scan in scans:
        mapper.update(scan)
    return mapper.train()


def questions(scan: Scan) -> tuple[np.ndarray, np.ndarray]:
    return _questions(scan, AREAS, np.random.default_rng(_SEED))


@pytest.mark.parametrize("config", [AREAS, SEGMENTS], ids=["areas", "segments"])
def test_leaving_a_scan_out_is_a_map_without_it(
    config: MapConfig, monkeypatch: pytest.MonkeyPatch
) -> None:
    # Experts keep their length scales, which a scan fewer would make a little longer.
    monkeypatch.setattr("gpom_core.mapper.length_scale_m", lambda *_: 0.2)
    scan = look(0.3, 0.2)
    without, whole = mapped([scan] * 3, config), mapped([scan] * 4, config)
    ((sums, occupied),) = leave_scans_out(whole, [scan], config)
    points, truth = questions(scan)
    expected, with_it = without.sums(points), whole.sums(points)
    np.testing.assert_allclose(sums, expected, rtol=1e-9, atol=1e-9)
    assert occupied.tolist() == truth.tolist()
    assert (np.abs(with_it - sums).max(axis=0) > 1e-3).all()  # it was not nothing that was left out


def test_the_only_scan_of_a_place_leaves_nothing_there() -> None:
    near, far = look(0.0, 0.0), scan_of(np.full(90, 2.0), 50.0, 50.0)
    ((sums, _),) = leave_scans_out(mapped([near, far]), [far], AREAS)
    assert len(sums) > 0
    assert not sums.any()


def test_the_questions_are_hits_and_free_places_of_some_beams() -> None:
    scan = look(0.3, 0.2, beams=360)
    points, occupied = questions(scan)
    assert occupied.sum() == BEAMS
    assert len(points) == 2 * BEAMS
    distance = np.hypot(*(points - scan.pose[:2]).T)
    assert np.isin(distance[occupied].astype(np.float32), scan.ranges_m).sum() > 0.9 * BEAMS
    assert (distance[~occupied] < distance[occupied] - 0.2 + 1e-6).all()
    assert len(np.unique(points, axis=0)) == 2 * BEAMS


def test_a_scan_that_saw_nothing_asks_nothing() -> None:
    scan = look(0.3, 0.2)
    empty = scan_of(np.full(90, np.inf), 0.3, 0.2)
    whole = mapped([scan, empty])
    assert list(leave_scans_out(whole, [empty], AREAS)) == []
    assert CalibrationJob(whole, (), AREAS).run() == Link()


def test_the_same_map_is_calibrated_the_same() -> None:
    scans = list(tour(6))
    whole = mapped(scans)
    job = CalibrationJob(whole, tuple(scans), AREAS)
    assert job.run() == job.run() == whole.link


def test_a_mapper_keeps_a_fair_draw_of_the_scans_that_tell_something() -> None:
    mapper = Mapper()
    for i in range(2 * SCANS):
        mapper.update(scan_of(np.full(8, 1.0), 20.0 * i))
    kept = mapper.kept_scans
    assert len(kept) == SCANS
    assert 0.25 < np.mean([scan.pose.x_m >= 20.0 * SCANS for scan in kept]) < 0.75
    for _ in range(50):  # a parked robot
        mapper.update(kept[0])
    assert mapper.kept_scans == kept


def test_a_calibration_is_due_when_much_is_new() -> None:
    mapper = Mapper()
    assert mapper.take_calibration() is None
    scans = list(tour(3))
    mapper.update(scans[0])
    mapper.swap([job.run() for job in mapper.take_jobs(1000)])
    job = mapper.take_calibration()
    assert job is not None
    assert job.scans == (scans[0],)
    version = mapper.snapshot().version
    assert mapper.calibrate(job, mapper.snapshot().link).version == version  # as good
    assert mapper.take_calibration() is None
    later = mapper.calibrate(job, Link((9.0, 0.0, 0.0, 0.0, 0.0, 0.0)))
    assert later.version == version + 1
    assert later.changed_bounds == later.reach


def test_a_calibration_is_due_until_it_ends() -> None:
    mapper = Mapper()
    scans = list(tour(3))
    mapper.update(scans[0])
    mapper.swap([job.run() for job in mapper.take_jobs(1000)])
    lost, job = mapper.take_calibration(), mapper.take_calibration()
    assert lost is not None
    assert job is not None
    assert job.trained == lost.trained > 0
    mapper.fail_calibration(job)
    assert mapper.take_calibration() is None
    assert mapper.take_calibration(even_if_little_is_new=True) is None, "nothing is"


def test_what_is_trained_during_a_calibration_counts_for_the_next() -> None:
    mapper = Mapper()
    first, second, _ = tour(3)
    mapper.update(first)
    mapper.swap([job.run() for job in mapper.take_jobs(1000)])
    calibration = mapper.take_calibration()
    assert calibration is not None
    mapper.update(second)
    trained = mapper.take_jobs(1000)
    mapper.swap([job.run() for job in trained])
    mapper.calibrate(calibration, calibration.run())
    later = mapper.take_calibration(even_if_little_is_new=True)
    assert later is not None
    assert later.trained == sum(len(job.observations) for job in trained)


def test_steps_are_the_whole_in_parts() -> None:
    scans = list(tour(6))
    job = CalibrationJob(mapped(scans), tuple(scans), AREAS)
    *before, link = job.steps()
    assert before == [None] * 6
    assert link == job.run()
