import threading
from concurrent.futures import ThreadPoolExecutor

import pytest

from gpom_core.config import MapConfig
from gpom_core.errors import InvalidScanError
from gpom_core.mapper import Mapper
from service.clock import SystemClock
from service.errors import StoppingError
from service.events import EventBus
from service.fleet import Fleet
from service.ingest import Batch
from service.journal import ScanRecord
from service.mapping import MapKeeper
from service.metrics import Metrics
from service.settings import IngestSettings, TrainingSettings
from tests.service.rooms import scan_at


class Rig:
    def __init__(self, config: MapConfig | None = None, **ingest) -> None:
        self.pool = ThreadPoolExecutor(1)
        self.mapper = Mapper(config)
        self.metrics = Metrics()
        self.keeper = MapKeeper(
            self.mapper,
            self.pool,
            MapConfig(),
            ingest=IngestSettings(**ingest),
            training=TrainingSettings(workers=1),
            events=EventBus(1),
            fleet=Fleet(1),
            metrics=self.metrics,
            clock=SystemClock(),
        )
        self.keeper.begin()
        self.ticket = 0

    def offer(self, *scans) -> int:
        self.ticket += max(1, len(scans))
        records = [ScanRecord("robot", "front", b"", 0.0, scan) for scan in scans]
        self.keeper.offer(Batch(records, self.ticket))
        return self.ticket

    def refused(self, reason: str) -> float:
        name = "gpom_scans_refused_total"
        return self.metrics.registry.get_sample_value(name, {"reason": reason}) or 0.0


@pytest.fixture
def rig():
    rigs = []

    def make(*config, **ingest) -> Rig:
        rigs.append(Rig(*config, **ingest))
        return rigs[-1]

    yield make
    for rig in rigs:
        rig.keeper.stop()
        if rig.keeper.worker.trouble() is None:
            assert rig.keeper.worker.join(30.0)
        rig.pool.shutdown()


def test_flush_means_integrated_and_trained(rig) -> None:
    rig = rig()
    rig.keeper.worker.start()
    ticket = rig.offer(*(scan_at(0.1 * i, seq=i + 1) for i in range(5)))
    rig.keeper.flush(ticket).result(60.0)
    state = rig.keeper.state
    assert state.scans_integrated == 5
    assert state.dirty == frozenset()
    assert state.snapshot.version > 0
    assert state.experts == len(state.snapshot.experts()) > 0
    assert state.observations > 0
    assert rig.keeper.trouble() is None


def test_flush_waits_for_the_halves_of_experts_that_are_split(rig) -> None:
    one = rig(MapConfig(max_observations=16, coarse_levels=0))
    one.keeper.worker.start()
    ticket = one.offer(*(scan_at(0.2 * i, 0.1 * i) for i in range(3)))
    one.keeper.flush(ticket).result(timeout=60.0)
    assert one.keeper.state.experts > 20
    assert not one.keeper.state.dirty


def test_flush_of_an_empty_map_is_done_at_once(rig) -> None:
    rig = rig()
    rig.keeper.worker.start()
    rig.keeper.flush(0).result(60.0)
    assert rig.keeper.state.snapshot.version == 0


def test_flush_of_refused_scans_is_done_too(rig) -> None:
    rig = rig()
    rig.keeper.worker.start()
    rig.keeper.flush(rig.offer()).result(60.0)


def test_flush_ends_while_scans_keep_coming(rig) -> None:
    rig = rig(backlog_scans_max=8)
    rig.keeper.worker.start()
    stop = threading.Event()

    def drive() -> None:
        step = 0
        while not stop.is_set():
            step += 1
            rig.offer(scan_at(1.5 * (step % 7) / 7, 1.5 * (step % 11) / 11, seq=step))

    robot = threading.Thread(target=drive)
    robot.start()
    try:
        for _ in range(3):
            rig.keeper.flush(rig.ticket).result(30.0)
    finally:
        stop.set()
        robot.join()


def test_a_cancelled_flush_is_forgotten(rig) -> None:
    rig = rig()
    flush = rig.keeper.flush(1)
    assert flush.cancel()
    rig.keeper.worker.start()
    rig.keeper.flush(rig.offer(scan_at())).result(60.0)
    assert rig.keeper._flushes == []


def test_stopping_gives_up_flushes_and_releases_who_is_blocked(rig) -> None:
    rig = rig(backlog_scans_max=1)
    rig.offer(scan_at())
    blocked = threading.Thread(target=rig.offer, args=(scan_at(),))
    blocked.start()
    flush = rig.keeper.flush(99)
    rig.keeper.stop()
    blocked.join(5.0)
    assert not blocked.is_alive()
    with pytest.raises(StoppingError):
        flush.result(5.0)
    with pytest.raises(StoppingError):
        rig.keeper.flush(0).result(5.0)


def test_scans_that_the_map_refuses_or_chokes_on_do_not_stop_it(rig, monkeypatch) -> None:
    rig = rig()
    update = rig.mapper.update

    def choosy(scan):
        if scan.seq == 1:
            raise InvalidScanError("pose_out_of_range", "too far away")
        if scan.seq == 2:
            raise ZeroDivisionError
        return update(scan)

    monkeypatch.setattr(rig.mapper, "update", choosy)
    rig.keeper.worker.start()
    rig.keeper.flush(rig.offer(*(scan_at(seq=seq) for seq in (1, 2, 3)))).result(60.0)
    assert rig.keeper.state.scans_integrated == 1
    assert rig.refused("pose_out_of_range") == 1
    assert rig.refused("internal_error") == 1


def test_an_old_state_stays_as_it_was(rig) -> None:
    rig = rig()
    rig.keeper.worker.start()
    rig.keeper.flush(rig.offer(scan_at())).result(60.0)
    before = rig.keeper.state
    known = before.snapshot.query([[0.0, 0.0]])
    rig.keeper.flush(rig.offer(scan_at(1.0, 1.0))).result(60.0)
    assert rig.keeper.state.snapshot.version > before.snapshot.version
    assert before.snapshot.query([[0.0, 0.0]]).mean == known.mean


def test_it_is_not_ready_before_it_is_warm(rig) -> None:
    rig = rig()
    assert "not running" in rig.keeper.trouble()
