"""Rasters that are kept: the newest for those who insist, the last one for those in a hurry."""

from concurrent.futures import Future

import pytest

from service.clock import ManualClock
from service.errors import BusyError
from service.raster_store import Raster, RasterStore


class Desk:
    """Draws when it is told to."""

    def __init__(self) -> None:
        self.calls: list[tuple[Future, object]] = []
        self.full = False

    def submit(self, call):
        if self.full:
            raise BusyError("full", 1)
        future: Future = Future()
        self.calls.append((future, call))
        return future

    def work(self) -> None:
        for future, call in self.calls:
            try:
                future.set_result(call())
            except ZeroDivisionError as error:
                future.set_exception(error)
        self.calls.clear()


@pytest.fixture
def desk() -> Desk:
    return Desk()


@pytest.fixture
def clock() -> ManualClock:
    return ManualClock()


@pytest.fixture
def store(desk, clock) -> RasterStore:
    return RasterStore(desk, 100, clock)


def drawn(store, desk, version, key="a", content=b"x" * 10):
    answer = store.raster(key, version, lambda: content)
    desk.work()
    return answer.result()


def test_the_newest_is_drawn_once(store, desk):
    first, second = (store.raster("a", 1, lambda: b"one") for _ in range(2))
    assert first is second
    desk.work()
    assert first.result().content == b"one"
    assert store.raster("a", 1, lambda: b"never") == first.result()


def test_another_version_is_another_raster(store, desk):
    drawn(store, desk, 1)
    assert drawn(store, desk, 2, content=b"two") == Raster(b"two", 2, 0.0)


def test_who_allows_age_gets_the_last_one_and_the_next_is_drawn(store, desk, clock):
    old = drawn(store, desk, 1)
    clock.advance(0.9)
    assert store.raster("a", 2, lambda: b"two", 1.0) is old
    assert store.raster("a", 3, lambda: b"three", 1.0) is old
    assert len(desk.calls) == 1
    desk.work()
    assert store.raster("a", 2, lambda: b"never", 1.0) == Raster(b"two", 2, 0.9)


def test_what_is_too_old_is_not_given(store, desk, clock):
    drawn(store, desk, 1)
    clock.advance(1.0)
    assert isinstance(store.raster("a", 2, lambda: b"two", 1.0), Future)


def test_who_insists_on_the_newest_does_not_get_what_is_being_drawn_of_an_older(store, desk):
    older, newer = store.raster("a", 1, lambda: b"one"), store.raster("a", 2, lambda: b"two")
    desk.work()
    assert (older.result().map_version, newer.result().map_version) == (1, 2)
    assert store.raster("a", 2, lambda: b"never").content == b"two"


def test_a_full_desk_refuses_only_those_who_must_wait(store, desk):
    old = drawn(store, desk, 1)
    desk.full = True
    assert store.raster("a", 2, lambda: b"two", 1.0) is old
    with pytest.raises(BusyError):
        store.raster("a", 2, lambda: b"two")


def test_what_failed_is_drawn_again(store, desk):
    failed = store.raster("a", 1, lambda: bytes(1 // 0))
    desk.work()
    with pytest.raises(ZeroDivisionError):
        failed.result()
    assert drawn(store, desk, 1, content=b"one").content == b"one"


def test_the_longest_unused_are_forgotten(store, desk):
    for key in "abcdefghij":
        drawn(store, desk, 1, key)
    assert isinstance(store.raster("a", 1, bytes), Raster)  # used: now the youngest
    drawn(store, desk, 1, "k")
    assert isinstance(store.raster("a", 1, bytes), Raster)
    assert isinstance(store.raster("b", 1, bytes), Future)


def test_what_is_larger_than_the_room_is_given_and_not_kept(store, desk):
    assert len(drawn(store, desk, 1, content=bytes(101)).content) == 101
    assert isinstance(store.raster("a", 1, bytes), Future)
