"""Workers die or hang: the expert is tried again, then set aside and shown; the rest goes on."""

import threading
import time
from concurrent.futures import BrokenExecutor, Executor, Future, ThreadPoolExecutor

import pytest

from gpom_core.config import MapConfig
from gpom_core.link import Link
from gpom_core.mapper import CalibrationJob, Mapper, TrainingJob
from service.clock import SystemClock
from service.errors import StoppingError
from service.map_service import MapService, Ports
from service.metrics import Metrics
from service.settings import Settings, TrainingSettings
from service.training import Training
from tests.service.conftest import COMPILE_S
from tests.service.rooms import payload_at, scan_at


class DyingExecutor(Executor):
    """Its worker dies with the first job; then it takes no more, as process pools do."""

    def __init__(self) -> None:
        self.dead = False

    def submit(self, function, /, *args):
        if self.dead:
            raise BrokenExecutor("a worker died")
        self.dead = True
        future = Future()
        future.set_exception(BrokenExecutor("a worker died"))
        return future


def test_dead_workers_are_replaced_and_their_jobs_done_again() -> None:
    mapper = Mapper(MapConfig())
    mapper.update(scan_at())
    renewed = []

    def renew() -> Executor:
        renewed.append(ThreadPoolExecutor(1) if len(renewed) else DyingExecutor())
        return renewed[-1]

    training = Training(
        mapper,
        DyingExecutor(),
        workers=1,
        swap_interval_s=0.01,
        attempts_max=5,
        renew=renew,
        metrics=Metrics(),
        clock=SystemClock(),
        wake=lambda: None,
    )
    end_s = time.monotonic() + 60.0
    while mapper.dirty_count and time.monotonic() < end_s:
        training.step()
        time.sleep(0.005)
    assert mapper.dirty_count == 0
    assert training.quarantined() == ()
    assert len(renewed) == 2
    renewed[-1].shutdown()


@pytest.fixture
def started(source, eventually):
    """Give services, started and ready, by their settings of training."""
    services = []

    def start(**training) -> MapService:
        services.append(MapService(Settings(training=TrainingSettings(**training)), Ports(source)))
        services[-1].start()
        eventually(lambda: not services[-1].troubles(), COMPILE_S)
        return services[-1]

    yield start
    for service in services:
        service.stop()


@pytest.fixture
def release():
    """What hangs, hangs until this is set."""
    event = threading.Event()
    yield event
    event.set()


def hang_one(monkeypatch, release) -> list[int]:
    """Let the expert that is trained next hang from now on; its number, once that is so."""
    run, stuck = TrainingJob.run, []

    def hang(job):
        if not stuck:
            stuck.append(job.cluster_id)
        if job.cluster_id == stuck[0]:
            release.wait()
        return run(job)

    monkeypatch.setattr(TrainingJob, "run", hang)
    return stuck


def test_a_calibration_that_hangs_is_given_up_and_nobody_waits_for_it(
    started, release, source, monkeypatch
) -> None:
    def hang(job):
        release.wait()
        yield job.snapshot.link

    service = started(workers=1, job_timeout_s=1.0)
    monkeypatch.setattr(CalibrationJob, "steps", hang)
    source.put("robot", "front", payload_at())
    service.flush().result(60.0)
    failures = service.metrics.registry.get_sample_value("gpom_training_failures_total")
    assert failures in (1.0, 2.0), "the one that was due, and the one of the flush"
    monkeypatch.undo()
    source.put("robot", "front", payload_at(1.0, 1.0, seq=2))
    service.flush().result(60.0)
    assert not service.state.dirty
    assert service.state.snapshot.link != Link()


@pytest.mark.parametrize("workers", [1, 2])
def test_an_expert_that_hangs_is_set_aside_and_the_map_goes_on(
    started, release, source, monkeypatch, workers
) -> None:
    service = started(workers=workers, job_timeout_s=1.0, attempts_max=2)
    stuck = hang_one(monkeypatch, release)
    source.put("robot", "front", payload_at())
    service.flush().result(60.0)
    (quarantined,) = service.state.quarantined
    assert quarantined.cluster_id == stuck[0]
    assert "did not end within 1 s" in quarantined.error
    assert len(service.state.snapshot.members) == service.state.experts - 1
    source.put("robot", "front", payload_at(1.0, 1.0, seq=2))
    service.flush().result(60.0)
    assert service.state.scans_integrated == 2
    assert b"gpom_quarantined_experts 1" in service.metrics.exposition()


def test_what_waits_behind_a_worker_that_hangs_is_done_by_the_next(
    started, release, source, monkeypatch
) -> None:
    service = started(workers=1, job_timeout_s=1.0, attempts_max=2)
    for seq in range(1, 8):
        source.put("robot", "front", payload_at(0.2 * seq, 0.1, seq=seq))
    service.flush().result(60.0)  # how long a job takes is known: several wait in the pool
    stuck = hang_one(monkeypatch, release)
    for seq in range(8, 16):
        source.put("robot", "front", payload_at(0.2 * seq - 2.0, 0.7, seq=seq))
    service.flush().result(60.0)
    assert [one.cluster_id for one in service.state.quarantined] == stuck
    assert service.state.dirty <= set(stuck)


def test_a_flush_does_not_hold_the_end(started, release, source, monkeypatch) -> None:
    service = started(workers=1)
    hang_one(monkeypatch, release)
    source.put("robot", "front", payload_at())
    flush = service.flush()
    service.hang_up()
    with pytest.raises(StoppingError):
        flush.result(5.0)
