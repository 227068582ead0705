"""The mapper: scans in, jobs out, results in, and what goes wrong on the way."""

import pickle
from collections.abc import Callable, Iterator
from concurrent.futures import Executor, Future, ThreadPoolExecutor
from dataclasses import replace

import numpy as np
import pytest

from gpom_core.clusters import length_m
from gpom_core.config import MapConfig
from gpom_core.errors import InvalidScanError
from gpom_core.expert import TrainingError
from gpom_core.link import Link
from gpom_core.mapper import Mapper, TrainingJob
from gpom_core.recalibration import CalibrationJob
from gpom_core.scan import Pose2D, Scan
from gpom_core.snapshot import Prediction
from tests.gpom_core.synthetic import ROOM, assert_consistent, look, moved, scan_of, tour

ALL = 10**6
POINTS = np.random.default_rng(0).uniform((-4.0, -3.0), (4.0, 3.0), (300, 2))


def mapper_of(*scans: Scan, **settings: object) -> Mapper:
    mapper = Mapper(MapConfig(**settings))  # type: ignore[arg-type]
    for scan in scans:
        mapper.update(scan)
    return mapper


def same(a: Prediction, b: Prediction) -> bool:
    return all(
        np.array_equal(getattr(a, name), getattr(b, name))
        for name in ("occupancy", "mean", "variance", "known")
    )


def assert_sound(mapper: Mapper) -> None:
    assert_consistent(mapper._evidence)


@pytest.mark.parametrize("mode", ["areas", "segments"])
def test_a_room_is_mapped(mode: str) -> None:
    mapper = mapper_of(*tour(10), free_evidence=mode)
    assert mapper.scan_count == 10
    assert mapper.dirty_count == mapper.expert_count > 5
    assert mapper.observation_count > 500
    snapshot = mapper.train()
    assert mapper.dirty_count == 0
    assert snapshot is mapper.snapshot()
    assert snapshot.version == 1
    assert sorted(snapshot.members) == [e.cluster_id for e in snapshot.experts()]
    assert len(snapshot.members) == mapper.expert_count
    walls = np.array([np.mean(ends, axis=0) for ends in ROOM])
    assert (snapshot.query(walls[[0, 3, 4]]).occupancy > 0.8).all()
    assert (snapshot.query([(0.0, 0.0), (-2.0, 1.0), (2.0, -1.0)]).occupancy < 0.15).all()
    assert_sound(mapper)


def test_the_same_scans_give_the_same_answers_bit_by_bit() -> None:
    answers = []
    for _ in range(2):
        mapper = Mapper()
        for i, scan in enumerate(tour(8)):
            mapper.update(scan)
            if i % 3 == 2:
                mapper.train()
        answers.append(mapper.train().query(POINTS))
    assert same(*answers)


def test_training_in_a_pool_gives_the_same_answers() -> None:
    alone = mapper_of(*tour(6)).train()
    with ThreadPoolExecutor(3) as pool:
        pooled = mapper_of(*tour(6)).train(pool)
    assert same(alone.query(POINTS), pooled.query(POINTS))


@pytest.mark.parametrize("shift", [(1e6, -1e6), (-800_000.0, 3_200_000.0)])
def test_far_from_the_origin_the_map_is_the_same(shift: tuple[float, float]) -> None:
    here = mapper_of(*tour(6)).train()
    there = mapper_of(*[moved(scan, *shift) for scan in tour(6)]).train()
    assert len(here.members) == len(there.members)
    a, b = here.query(POINTS), there.query(POINTS + np.array(shift))
    np.testing.assert_allclose(b.mean, a.mean, atol=1e-4)
    np.testing.assert_allclose(b.variance, a.variance, atol=1e-4)
    np.testing.assert_allclose(b.occupancy, a.occupancy, atol=1e-4)


def test_a_refused_scan_changes_nothing() -> None:
    mapper = mapper_of(*tour(3), hit_cell_m=0.02)
    before = mapper.train().query(POINTS)
    counts = (mapper.scan_count, mapper.observation_count, mapper.expert_count)
    with pytest.raises(InvalidScanError, match="farther from the origin"):
        mapper.update(replace(look(0.0, 0.0), pose=Pose2D(9e6, 0.0, 0.0)))
    assert (mapper.scan_count, mapper.observation_count, mapper.expert_count) == counts
    assert mapper.dirty_count == 0
    assert same(mapper.train().query(POINTS), before)


def test_a_scan_without_news_leaves_the_version_as_it_is() -> None:
    mapper = mapper_of(scan_of([np.nan] * 5))
    assert mapper.take_jobs(ALL) == []
    assert mapper.train().version == 0
    mapper.update(look(0.0, 0.0))
    version = mapper.train().version
    assert mapper.train().version == version


def test_clusters_are_no_longer_than_allowed_after_any_update() -> None:
    mapper = Mapper(MapConfig(max_length_m=1.2))
    for scan in tour(10, noise=0.02):
        mapper.update(scan)
        clusters = mapper._evidence.clusters
        assert max(length_m(clusters, c) for c in range(int(clusters.size[0]))) <= 1.2
    assert_sound(mapper)


def test_experts_are_no_larger_than_allowed() -> None:
    mapper = mapper_of(*tour(10), max_observations=60, coarse_levels=0)
    jobs = mapper.take_jobs(ALL)
    assert len(jobs) > 20
    assert max(len(job.observations) for job in jobs) <= 60
    assert len({job.cluster_id for job in jobs}) == len(jobs)
    assert sum(len(job.observations) for job in jobs) == mapper.observation_count
    assert_sound(mapper)


def test_jobs_are_given_out_once_the_most_changed_first() -> None:
    mapper = mapper_of(*tour(4), max_observations=2000)  # none is split on the way
    dirty = mapper.dirty_count
    first = mapper.take_jobs(3)
    rest = mapper.take_jobs(ALL)
    assert len(first) == 3
    ids = [job.cluster_id for job in first + rest]
    assert len(ids) == len(set(ids)) >= dirty
    assert mapper.take_jobs(ALL) == []
    sizes = [len(job.observations) for job in first]
    assert min(sizes) > np.median([len(job.observations) for job in rest])
    assert mapper.dirty_ids() == set(ids)  # until they are swapped in
    mapper.swap([job.run() for job in first])
    assert mapper.dirty_ids() == {job.cluster_id for job in rest}


def test_no_jobs_are_taken_where_none_are_wanted() -> None:
    mapper = mapper_of(*tour(2))
    assert mapper.take_jobs(0) == []
    assert mapper.dirty_count == mapper.expert_count


def test_an_expert_in_training_is_dirty_again_when_it_grows() -> None:
    mapper = mapper_of(look(0.0, 0.0))
    jobs = {job.cluster_id: job for job in mapper.take_jobs(ALL)}
    for _ in range(3):
        mapper.update(look(0.0, 0.0))
    assert mapper.take_jobs(ALL) == []  # all are in training
    mapper.swap([job.run() for job in jobs.values()])
    again = mapper.take_jobs(ALL)
    assert again
    for job in again:
        assert job.revision > jobs[job.cluster_id].revision
        assert job.observations.count.sum() > jobs[job.cluster_id].observations.count.sum()


def test_results_older_than_the_map_are_discarded() -> None:
    mapper = mapper_of(look(0.0, 0.0))
    old = [job.run() for job in mapper.take_jobs(ALL)]
    mapper.swap(old)
    mapper.update(look(0.3, 0.1))
    new = mapper.train()
    assert mapper.swap(old) is new
    for member in new.members.values():
        assert mapper.snapshot().members[member.cluster_id] is member


def test_the_same_result_twice_counts_once() -> None:
    mapper = mapper_of(look(0.0, 0.0))
    trained = [job.run() for job in mapper.take_jobs(ALL)]
    first = mapper.swap(trained)
    assert mapper.swap(trained) is first


def test_an_expert_that_failed_is_dirty_again() -> None:
    mapper = mapper_of(look(0.0, 0.0))
    job, *others = mapper.take_jobs(ALL)
    mapper.swap([other.run() for other in others])
    mapper.fail(job)
    assert mapper.dirty_ids() == {job.cluster_id}
    (again,) = mapper.take_jobs(ALL)
    assert again.cluster_id == job.cluster_id
    assert again.revision > job.revision


def test_an_expert_that_was_set_aside_waits_for_news() -> None:
    mapper = mapper_of(look(0.0, 0.0))
    job, *others = mapper.take_jobs(ALL)
    mapper.swap([other.run() for other in others])
    mapper.set_aside(job)
    assert mapper.dirty_count == 0
    assert job.cluster_id not in mapper.snapshot().members
    for _ in range(3):
        mapper.update(look(0.0, 0.0))
    assert job.cluster_id in mapper.dirty_ids()
    assert job.cluster_id in mapper.train().members


def failing(broken: int) -> Callable[[TrainingJob], object]:
    run = TrainingJob.run

    def maybe(job: TrainingJob) -> object:
        if job.cluster_id == broken:
            raise TrainingError("as planned")
        return run(job)

    return maybe


def test_an_expert_that_cannot_be_trained_holds_up_no_other(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    mapper = mapper_of(*tour(3), max_observations=2000)
    broken = min(mapper.dirty_ids())
    with monkeypatch.context() as patch:
        patch.setattr(TrainingJob, "run", failing(broken))
        with pytest.raises(TrainingError, match="as planned"):
            mapper.train()
    assert mapper.dirty_ids() == {broken}
    assert len(mapper.snapshot().members) == mapper.expert_count - 1
    assert broken in mapper.train().members


def test_a_calibration_that_fails_loses_no_expert(monkeypatch: pytest.MonkeyPatch) -> None:
    mapper = mapper_of(*tour(3), max_observations=2000)
    broken = min(mapper.dirty_ids())

    def fail(_: CalibrationJob) -> Link:
        raise TrainingError("cannot be calibrated")

    with monkeypatch.context() as patch:
        patch.setattr(TrainingJob, "run", failing(broken))
        patch.setattr(CalibrationJob, "run", fail)
        with pytest.raises(TrainingError, match="cannot be calibrated"):
            mapper.train()
    before = mapper.snapshot()
    assert len(before.members) == mapper.expert_count - 1
    assert mapper.dirty_ids() == {broken}
    assert mapper.train().link != before.link


def test_a_calibration_alone_is_another_version() -> None:
    mapper = mapper_of(*tour(3), max_observations=2000)
    before = mapper.swap([job.run() for job in mapper.take_jobs(ALL)])
    later = mapper.train()
    assert later.link != before.link
    assert later.version == before.version + 1


class BrokenExecutor(Executor):
    """Takes work and does none of it."""

    def submit(self, fn: object, /, *args: object, **kwargs: object) -> Future[object]:  # type: ignore[override]
        future: Future[object] = Future()
        future.set_exception(OSError("the other machine is gone"))
        return future


def test_an_executor_that_breaks_loses_no_expert() -> None:
    mapper = mapper_of(*tour(3), max_observations=2000)  # none is split on the way
    dirty = mapper.dirty_ids()
    with pytest.raises(OSError, match="gone"):
        mapper.train(BrokenExecutor())
    assert mapper.dirty_ids() == dirty
    assert len(mapper.train().members) == mapper.expert_count


def open_field() -> Scan:
    return scan_of([np.inf] * 24, 0.0, 0.0, range_max=0.9)


def test_an_expert_whose_evidence_moved_away_is_removed() -> None:
    mapper = mapper_of(open_field())
    (alone,) = mapper.train().members
    # Walls all around: every free area is now nearest to one of them.
    box = [((-1, -1), (1, -1)), ((1, -1), (1, 1)), ((1, 1), (-1, 1)), ((-1, 1), (-1, -1))]
    mapper.update(look(0.0, 0.0, walls=box, beams=360))
    assert mapper._evidence.clusters.rows[alone] == 0
    assert alone in mapper.dirty_ids()
    snapshot = mapper.train()
    assert alone not in snapshot.members
    assert mapper.dirty_count == 0
    assert mapper.expert_count == len(snapshot.members)
    fresh = mapper_of(look(0.0, 0.0, walls=box, beams=360))
    assert alone == 0 or fresh.expert_count == mapper.expert_count


def test_a_result_for_a_cluster_that_is_gone_is_discarded() -> None:
    mapper = mapper_of(open_field())
    late = [job.run() for job in mapper.take_jobs(ALL)]
    box = [((-1, -1), (1, -1)), ((1, -1), (1, 1)), ((1, 1), (-1, 1)), ((-1, 1), (-1, -1))]
    mapper.update(look(0.0, 0.0, walls=box, beams=360))
    assert late[0].cluster_id not in mapper.swap(late).members
    assert late[0].cluster_id not in mapper.train().members
    assert late[0].cluster_id not in mapper.swap(late).members


def test_jobs_and_results_travel_to_other_processes() -> None:
    mapper, other = mapper_of(*tour(3)), mapper_of(*tour(3))
    jobs = pickle.loads(pickle.dumps(mapper.take_jobs(ALL)))
    travelled = pickle.loads(pickle.dumps([job.run() for job in jobs]))
    stayed = other.swap([job.run() for job in other.take_jobs(ALL)])
    assert same(mapper.swap(travelled).query(POINTS), stayed.query(POINTS))


def test_queries_from_many_threads_see_whole_versions_while_others_are_swapped_in() -> None:
    mapper = mapper_of(*tour(3))
    snapshots = {s.version: s for s in [mapper.train()]}
    answers: list[tuple[int, Prediction]] = []
    running = True

    def ask() -> Iterator[tuple[int, Prediction]]:
        while running:
            snapshot = mapper.snapshot()
            yield snapshot.version, snapshot.query(POINTS)

    with ThreadPoolExecutor(3) as pool:
        asking = [pool.submit(list, ask()) for _ in range(3)]
        try:
            for scan in tour(12)[3:]:
                mapper.update(scan)
                snapshot = mapper.train()
                snapshots[snapshot.version] = snapshot
        finally:
            running = False
        for asked in asking:
            answers += asked.result(timeout=60)
    assert len({version for version, _ in answers}) > 1
    expected = {version: s.query(POINTS) for version, s in snapshots.items()}
    for version, answer in answers:
        assert same(answer, expected[version])


def test_learned_experts_differ_and_answer_well() -> None:
    mapper = mapper_of(*tour(5), learn_hyperparameters=True)
    snapshot = mapper.train()
    scales = {e.length_scale_m for e in snapshot.experts()}
    assert len(scales) > 3
    assert snapshot.query([(0.0, 0.0)]).occupancy[0] < 0.15
    assert snapshot.query([(-3.03, 0.5)]).occupancy[0] > 0.8


def test_length_scales_are_longer_where_few_beams_went() -> None:
    def scales(scans: int) -> np.ndarray:
        mapper = mapper_of(*([look(0.3, 0.2, beams=180)] * scans))
        return np.array([e.length_scale_m for e in mapper.train().experts()])

    few, many = scales(1), scales(300)
    assert few.max() <= 1.6 * 0.2 + 1e-12
    assert many.min() >= 0.85 * 0.2 - 1e-12
    assert np.median(few) > 0.2 > np.median(many)
    plain = mapper_of(look(0.3, 0.2), free_evidence="segments").train().experts()
    assert {e.length_scale_m for e in plain} == {0.2}


def test_a_refresh_trains_also_what_is_hardly_news() -> None:
    mapper = Mapper()
    for i in range(60):
        mapper.update(look(0.3, 0.2, beams=180, noise=0.01, seed=i))
        mapper.swap([job.run() for job in mapper.take_jobs(ALL)])
    lazy = mapper.snapshot().query(POINTS).variance
    mapper.refresh()
    assert mapper.dirty_count > 0
    mapper.swap([job.run() for job in mapper.take_jobs(ALL)])
    fresh = mapper.snapshot().query(POINTS).variance
    assert (fresh <= lazy + 1e-6).mean() > 0.9  # more was seen, so more is known
    assert fresh.sum() < lazy.sum()
    mapper.refresh()
    assert mapper.dirty_count == 0


@pytest.mark.parametrize(
    ("signal", "hit", "free", "length"),
    [(100.0, 0.01, 0.01, 5.0), (0.01, 0.001, 1e3, 0.011)],
)
def test_settings_at_their_bounds_still_give_numbers(
    signal: float, hit: float, free: float, length: float
) -> None:
    scales = {"signal_std": signal, "hit_noise_std": hit, "free_noise_std": free}
    mapper = mapper_of(look(0.3, 0.2), length_scale_m=length, **scales)
    answer = mapper.train().query(POINTS[:30])
    assert np.isfinite([answer.occupancy, answer.mean, answer.variance]).all()
