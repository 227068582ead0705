import time
from concurrent.futures import Executor, Future, ThreadPoolExecutor

import pytest

from gpom_core.config import MapConfig
from gpom_core.link import Link
from gpom_core.mapper import Mapper, TrainingJob
from service.clock import ManualClock
from service.metrics import Metrics
from service.training import Training
from tests.service.rooms import scan_at


class PatientExecutor(Executor):
    """Runs what was submitted when told to."""

    def __init__(self) -> None:
        self.waiting = []

    def submit(self, function, /, *args):
        future = Future()
        self.waiting.append((future, function, args))
        return future

    def run(self, count: int | None = None) -> None:
        now, self.waiting = self.waiting[:count], self.waiting[count:] if count else []
        for future, function, args in now:
            future.set_result(function(*args))


class Rig:
    def __init__(self, **options) -> None:
        self.mapper = Mapper(MapConfig())
        self.pool = PatientExecutor()
        self.clock = ManualClock()
        self.metrics = Metrics()
        self.wakes = 0
        self.training = Training(
            self.mapper,
            self.pool,
            workers=options.get("workers", 1),
            swap_interval_s=0.1,
            attempts_max=3,
            metrics=self.metrics,
            clock=self.clock,
            wake=self._wake,
        )

    def _wake(self) -> None:
        self.wakes += 1

    def finish(self) -> None:
        for _ in range(100):
            self.training.step()
            if not self.pool.waiting and not self.mapper.dirty_count:
                return
            self.pool.run()
            self.clock.advance(0.01)
        pytest.fail("training does not end")


@pytest.fixture
def rig() -> Rig:
    return Rig()


def test_nothing_to_do_is_nothing_new(rig) -> None:
    assert rig.training.step() is None
    assert rig.training.seconds_to_swap() is None


def test_dirty_experts_are_trained_and_swapped_in(rig) -> None:
    rig.mapper.update(scan_at())
    rig.finish()
    assert rig.mapper.dirty_count == 0
    assert rig.mapper.snapshot().version > 0
    assert len(rig.mapper.snapshot().experts()) == rig.mapper.expert_count > 0
    assert rig.wakes > 0


def test_helpers_do_the_work_until_they_are_given_back(rig) -> None:
    with ThreadPoolExecutor(2) as helpers:
        rig.training.borrow(helpers, 2)
        for step in range(3):
            rig.mapper.update(scan_at(0.2 * step, 0.1))
        number = rig.training.calibrate()
        end_s = time.monotonic() + 60.0
        while not rig.training.calibrated(number):
            assert time.monotonic() < end_s
            rig.training.step()
            time.sleep(0.001)
        assert rig.mapper.snapshot().link != Link()
        assert rig.pool.waiting == []
        rig.training.give_back()
    rig.mapper.update(scan_at(1.0, 1.0))
    rig.training.step()
    assert rig.pool.waiting


def test_results_wait_for_company_but_not_for_long(rig) -> None:
    rig.mapper.update(scan_at())
    rig.training.step()
    assert len(rig.pool.waiting) > 1, "the first estimate of a job's duration is a cautious one"
    rig.clock.advance(0.1)
    rig.pool.run(1)
    assert rig.training.step() is not None, "long since the last swap"
    rig.pool.run(1)
    assert rig.training.step() is None
    assert 0.0 < rig.training.seconds_to_swap() <= 0.1
    rig.clock.advance(0.1)
    assert rig.training.step() is not None


def test_the_last_results_do_not_wait(rig) -> None:
    rig.mapper.update(scan_at())
    rig.finish()
    rig.mapper.update(scan_at(1.0, 1.0))
    rig.training.step()
    while rig.pool.waiting:
        rig.pool.run()
        swap = rig.training.step()
    assert swap is not None
    assert rig.training.seconds_to_swap() is None


def test_the_pool_is_never_flooded(rig) -> None:
    for step in range(20):
        rig.mapper.update(scan_at(0.1 * step, 0.05 * step))
    rig.training.step()
    taken = sum(len(args[0]) for _, _, args in rig.pool.waiting)
    assert taken < rig.mapper.dirty_count
    rig.finish()


def test_the_turn_of_a_swap_is_that_in_which_its_job_was_taken(rig) -> None:
    rig.mapper.update(scan_at())
    rig.training.step()
    taken = rig.training.turn
    rig.pool.run()
    rig.clock.advance(0.2)  # no longer waits for those taken since
    swap = rig.training.step()
    assert set(swap.turns.values()) == {taken}
    assert set(swap.turns) <= {expert.cluster_id for expert in swap.snapshot.experts()}


def test_a_failing_expert_is_tried_again_then_set_aside_and_the_others_go_on(
    rig, monkeypatch
) -> None:
    rig.mapper.update(scan_at())
    bad = min(rig.mapper.dirty_ids())
    run, broken = TrainingJob.run, [True]

    def fail(job):
        if job.cluster_id == bad and broken[0]:
            raise ArithmeticError("no")
        return run(job)

    monkeypatch.setattr(TrainingJob, "run", fail)
    rig.finish()
    assert rig.metrics.registry.get_sample_value("gpom_training_failures_total") == 3
    (quarantine,) = rig.training.quarantined()
    assert quarantine.cluster_id == bad
    assert "no" in quarantine.error
    trained = {expert.cluster_id for expert in rig.mapper.snapshot().experts()}
    assert bad not in trained
    assert len(trained) == rig.mapper.expert_count - 1

    broken[0] = False
    for step in range(1, 6):
        rig.mapper.update(scan_at(0.2 * step, 0.1 * step))
    rig.finish()
    assert rig.training.quarantined() == (), "new evidence is a new chance"
