from collections.abc import Callable

import pytest

from service.clock import ManualClock
from service.events import EventBus
from service.fleet import Fleet
from service.ingest import Batch, Ingest
from service.journal import MemoryJournal
from service.metrics import Metrics
from service.sequences import SILENCE_S, Cursor, SensorKey
from service.settings import IngestSettings
from tests.service.rooms import payload_at


class Rig:
    """Ingest with everything around it in memory; what happens is written down in order."""

    def __init__(self, **settings) -> None:
        self.happened: list[tuple[str, object]] = []
        self.position = 0
        self.journal = MemoryJournal()
        self.store = self.journal.append
        self.fleet = Fleet(robots_max=2)
        self.metrics = Metrics()
        self.clock = ManualClock(1000.0)
        self.settings = IngestSettings(**settings)
        self.ingest = self.opened()

    def opened(self) -> Ingest:
        return Ingest(
            self.settings,
            journal=self,
            hand_on=lambda batch: self.happened.append(("map", batch)),
            fleet=self.fleet,
            events=EventBus(1),
            metrics=self.metrics,
            clock=self.clock,
            acknowledge=lambda cursors: self.happened.append(("ack", dict(cursors))),
        )

    def reopen(self) -> None:
        """Go on as after a restart, with what the journal knows."""
        self.ingest = self.opened()
        self.ingest.resume()

    def cursors(self):
        return self.journal.cursors()

    def robots(self):
        return self.journal.robots()

    def append(self, records) -> None:
        self.store(records)
        self.happened.append(("journal", len(records)))

    def close(self) -> None:
        pass

    def run(self) -> None:
        """Handle all that is in the queue, and end."""
        self.ingest.queue.close()
        self.ingest.worker.start()
        assert self.ingest.worker.join(10.0)

    def batches(self) -> list[Batch]:
        return [what for name, what in self.happened if name == "map"]

    def refused(self, reason: str) -> float:
        name = "gpom_scans_refused_total"
        return self.metrics.registry.get_sample_value(name, {"reason": reason}) or 0.0


@pytest.fixture
def rig() -> Callable[..., Rig]:
    return Rig


def test_scans_are_stored_then_acknowledged_then_integrated(rig) -> None:
    rig = rig()
    for seq in (1, 2, 3):
        rig.ingest.on_scan("robot", "front", payload_at(seq=seq))
    rig.run()
    assert [name for name, _ in rig.happened] == ["journal", "ack", "map"]
    assert rig.happened[1][1] == {SensorKey("robot", "front"): Cursor(1, 3)}
    (batch,) = rig.batches()
    assert batch.ticket == 3
    assert [record.scan.seq for record in batch.records] == [1, 2, 3]
    assert batch.records[0].payload == payload_at(seq=1)


def test_what_cannot_be_stored_is_neither_acknowledged_nor_integrated(rig) -> None:
    rig = rig()
    rig.journal.broken = "disk is full"
    rig.ingest.on_scan("robot", "front", payload_at(seq=1))
    rig.run()
    (batch,) = rig.batches()
    assert list(batch.records) == []
    assert batch.ticket == 1, "a flush must not wait for it"
    assert [name for name, _ in rig.happened] == ["map"]
    assert rig.refused("not_stored") == 1
    assert rig.fleet.robots() == ()


def test_a_scan_that_was_not_stored_is_new_when_it_is_repeated(rig) -> None:
    rig = rig(batch_scans_max=1)
    rig.journal.broken = "disk is full"

    def heal_after_one(records) -> None:
        try:
            rig.journal.append(records)
        finally:
            rig.journal.broken = None

    rig.store = heal_after_one
    rig.ingest.on_scan("robot", "front", payload_at(seq=1))
    rig.ingest.on_scan("robot", "front", payload_at(seq=1))
    rig.run()
    assert [len(batch.records) for batch in rig.batches()] == [0, 1]
    assert rig.refused("stale") == 0


def test_a_broken_journal_shows_until_it_works_again(rig, eventually) -> None:
    rig = rig()
    rig.journal.broken = "disk is full"
    rig.ingest.worker.start()
    rig.ingest.on_scan("robot", "front", payload_at(seq=1))
    eventually(lambda: bool(rig.batches()))
    assert "disk is full" in rig.ingest.trouble()
    rig.journal.broken = None
    rig.ingest.on_scan("robot", "front", payload_at(seq=2))
    eventually(lambda: len(rig.batches()) == 2)
    assert rig.ingest.trouble() is None
    rig.ingest.queue.close()
    assert rig.ingest.worker.join(10.0)
    assert "not running" in rig.ingest.trouble()


def test_bad_bytes_are_refused_with_their_reason(rig) -> None:
    rig = rig()
    good = payload_at(seq=1)
    for payload in (b"", b"hello", good[:-1], good[:130] + b"\x01" + good[131:], good):
        rig.ingest.on_scan("robot", "front", payload)
    rig.run()
    assert rig.refused("truncated") == 3
    assert rig.refused("bad_crc") == 1
    assert [len(batch.records) for batch in rig.batches()] == [1]


def test_repeats_are_refused_and_gaps_counted_per_robot(rig) -> None:
    rig = rig()
    for seq in (1, 1, 2, 5):
        rig.ingest.on_scan("a", "front", payload_at(seq=seq))
    rig.ingest.on_scan("b", "front", payload_at(2.0, 1.0, seq=9))
    rig.run()
    assert rig.refused("stale") == 1
    a, b = rig.fleet.robots()
    assert (a.scans, a.lost, b.scans, b.lost) == (3, 2, 1, 0)
    assert b.pose == (2.0, 1.0, 0.0)
    assert b.last_seen_unix_s == 1000.0
    assert rig.metrics.registry.get_sample_value("gpom_scans_lost_total") == 2


def test_robots_beyond_the_limit_are_refused(rig) -> None:
    rig = rig()
    for robot in ("a", "b", "c", "a"):
        rig.ingest.on_scan(robot, "front", payload_at(seq=0))
    rig.run()
    assert rig.refused("too_many_robots") == 1
    assert [robot.id for robot in rig.fleet.robots()] == ["a", "b"]


def test_a_scan_with_too_many_beams_is_stored_and_holds_nothing_up(rig) -> None:
    rig = rig(beams_max=10)
    payloads = [payload_at(seq=seq, reliable=True) for seq in (1, 2)]
    for payload in payloads:
        rig.ingest.on_scan("a", "front", payload)
    rig.run()
    assert [record.payload for record in rig.journal.records] == payloads
    assert rig.happened[1] == ("ack", {SensorKey("a", "front"): Cursor(1, 2)})
    (batch,) = rig.batches()
    for record in batch.records:
        assert record.withheld == "too_many_beams"
        assert (record.payload, len(record.scan.ranges_m)) == (b"", 1), "nothing large waits"


def test_refusals_are_told_by_robot_and_reason(rig) -> None:
    rig = rig()
    for seq in (1, 1, 2, 1):
        rig.ingest.on_scan("a", "front", payload_at(seq=seq, boot=9))
    rig.ingest.on_scan("a", "front", payload_at(seq=1, boot=5))
    rig.ingest.on_scan("a", "front", b"junk")
    rig.ingest.on_scan("stranger", "front", b"junk")
    rig.run()
    (robot,) = rig.fleet.robots()
    assert robot.refused == {"stale": 2, "old_run": 1, "truncated": 1}


def test_a_robot_whose_clock_went_back_is_heard_again(rig) -> None:
    rig = rig(batch_scans_max=1)
    rig.ingest.on_scan("a", "front", payload_at(seq=3, boot=9))
    rig.run()
    rig.reopen()
    rig.clock.advance(SILENCE_S)
    rig.ingest.on_scan("a", "front", payload_at(seq=1, boot=5))
    rig.ingest.on_scan("a", "front", payload_at(seq=2, boot=5))
    rig.run()
    (robot,) = rig.fleet.robots()
    assert (robot.scans, robot.lost, robot.refused) == (3, 0, {})
    assert [record.boot for record in rig.journal.records] == [9, 10, 10]


def test_robots_are_known_again_after_a_restart(rig) -> None:
    rig = rig()
    for seq in (1, 2, 5):
        rig.ingest.on_scan("a", "front", payload_at(1.0, 0.5, seq=seq))
    rig.run()
    before = rig.fleet.robots()
    rig.fleet = Fleet(robots_max=2)
    rig.reopen()
    assert rig.fleet.robots() == before
    assert (before[0].scans, before[0].lost, before[0].pose) == (3, 2, (1.0, 0.5, 0.0))


def test_the_thread_survives_what_nobody_thought_of(rig) -> None:
    rig = rig(batch_scans_max=1)
    broken = iter([True, False])

    def append(records) -> None:
        if next(broken):
            raise ZeroDivisionError

    rig.store = append
    rig.ingest.on_scan("a", "front", payload_at(seq=1))
    rig.ingest.on_scan("a", "front", payload_at(seq=2))
    rig.run()
    assert [(batch.ticket, len(batch.records)) for batch in rig.batches()] == [(1, 0), (2, 1)]
