"""Workers die or hang: the expert is tried again, then set aside and shown; the rest goes on."""

import threading
import time
from concurrent.futures import BrokenExecutor, Executor, Future, ThreadPoolExecutor

from gpom_core.config import MapConfig
from gpom_core.link import Link
from gpom_core.mapper import CalibrationJob, Mapper, TrainingJob
from service.clock import SystemClock
from service.map_service import MapService, Ports
from service.metrics import Metrics
from service.settings import Settings, TrainingSettings
from service.training import Training
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


def test_a_calibration_that_hangs_is_given_up_and_nobody_waits_for_it(
    source, eventually, monkeypatch
) -> None:
    release = threading.Event()

    def hang(job):
        release.wait()
        yield job.snapshot.link

    settings = Settings(training=TrainingSettings(workers=1, job_timeout_s=1.0))
    service = MapService(settings, Ports(source))
    service.start()
    try:
        eventually(lambda: not service.troubles(), 100.0)
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
    finally:
        release.set()
        service.stop()


def test_an_expert_that_hangs_is_set_aside_and_the_map_goes_on(
    source, eventually, monkeypatch
) -> None:
    release = threading.Event()
    run, stuck = TrainingJob.run, []

    def hang_one(job):
        if not stuck:
            stuck.append(job.cluster_id)
        if job.cluster_id == stuck[0]:
            release.wait()
        return run(job)

    settings = Settings(training=TrainingSettings(workers=2, job_timeout_s=1.0, attempts_max=2))
    service = MapService(settings, Ports(source))
    service.start()
    try:
        eventually(lambda: not service.troubles(), 100.0)
        monkeypatch.setattr(TrainingJob, "run", hang_one)
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
    finally:
        release.set()
        service.stop()
