"""When the map is saved: now and then, and when robots have come to rest."""

import threading
from collections.abc import Iterator

import pytest

from gpom_core.mapper import Mapper
from service.clock import ManualClock
from service.metrics import Metrics
from service.saver import Saver
from tests.service.rooms import scan_at


class Rig:
    def __init__(self) -> None:
        self.clock = ManualClock()
        self.mapper = Mapper()
        self.mapper.update(scan_at())
        self.saved: list[int] = []
        self.written = threading.Event()
        self.written.set()
        self.saver = Saver(self._save, 0, interval_s=60.0, metrics=Metrics(), clock=self.clock)

    def _save(self, image, position: int) -> None:
        assert self.written.wait(30.0)
        self.saved.append(position)

    def offer(self, position: int) -> None:
        """As the mapping thread does, and wait until what it began is written."""
        self.saver.offer(self.mapper, position)
        if self.written.is_set() and self.saver._running is not None:
            self.saver._running.result(30.0)

    def drive(self, first: int, last: int, period_s: float) -> None:
        for position in range(first, last + 1):
            self.offer(position)
            self.clock.advance(period_s)
            self.offer(position)


@pytest.fixture
def rig() -> Iterator[Rig]:
    rig = Rig()
    yield rig
    rig.written.set()
    rig.saver.close()


def test_without_news_there_is_nothing_to_save(rig) -> None:
    rig.clock.advance(1000.0)
    assert rig.saver.seconds_to_save() is None
    rig.offer(0)
    assert rig.saved == []


def test_while_scans_come_it_is_saved_once_an_interval(rig) -> None:
    rig.drive(1, 1000, period_s=0.125)
    assert rig.saved == [480, 960]


def test_when_robots_rest_it_is_saved_soon(rig) -> None:
    rig.clock.advance(20.0)
    rig.drive(1, 10, period_s=0.125)
    assert rig.saver.seconds_to_save() == 1.875
    rig.clock.advance(1.875)
    rig.offer(10)
    assert rig.saved == [10]
    assert rig.saver.seconds_to_save() is None


def test_robots_that_rest_often_do_not_wear_the_disk(rig) -> None:
    rig.drive(1, 40, period_s=3.0)
    gaps = [later - sooner for sooner, later in zip(rig.saved, rig.saved[1:], strict=False)]
    assert 10 <= len(rig.saved) <= 12, "one in 10 s at the most"
    assert min(gaps) >= 3


def test_a_copy_that_is_being_written_is_waited_for_without_haste(rig) -> None:
    rig.written.clear()
    rig.clock.advance(60.0)
    rig.offer(1)
    rig.clock.advance(100.0)
    rig.offer(2)
    assert rig.saver.seconds_to_save() == pytest.approx(0.1)
    rig.written.set()
    rig.saver._running.result(30.0)
    rig.offer(2)
    assert rig.saved == [1, 2]
