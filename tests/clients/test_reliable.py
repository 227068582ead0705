"""Reliable delivery against a stand-in for the map that forgets, drops and goes away."""

import asyncio
import threading
import time
from dataclasses import replace

import pytest

from clients.errors import (
    DeliveryError,
    OutboxFullError,
    ScanDroppedError,
    SupersededError,
    UnknownScanError,
)
from clients.outbox import OutboxSettings
from clients.publisher import ScanPublisher
from tests.clients.conftest import running_map
from tests.clients.test_publisher import SCAN

QUICK = OutboxSettings(silence_s=0.1)


def publisher(fake, name="r1", **options) -> ScanPublisher:
    options.setdefault("outbox", QUICK)
    return ScanPublisher(name, endpoints=[fake.endpoint], **options)


def stamps(fake):
    return [scan.stamp_ns for scan in fake.scans()]


@pytest.fixture
def leaves_soon(monkeypatch):
    monkeypatch.setattr("clients.publisher.CLOSE_TIMEOUT_S", 0.1)


def test_scans_published_before_the_map_is_there_arrive(silent_map):
    with publisher(silent_map) as robot:
        for i in range(20):
            robot.publish(replace(SCAN, stamp_ns=i))
        assert (robot.waiting, robot.ready) == (20, False)
        silent_map.subscribe()
        silent_map.appear()
        assert robot.drain(20.0)
    assert stamps(silent_map) == list(range(20))


def test_what_is_lost_on_the_way_is_sent_again(fake_map):
    fake_map.drop_every = 7
    with publisher(fake_map) as robot:
        for i in range(40):
            robot.publish(replace(SCAN, stamp_ns=i))
        assert robot.drain(30.0)
    assert stamps(fake_map) == list(range(40))


def test_lost_acknowledgements_are_made_good_by_the_cursor(fake_map):
    fake_map.acknowledges = False
    with publisher(fake_map) as robot:
        robot.publish(SCAN)
        assert robot.drain(20.0)
    assert len(fake_map.scans()) == 1


def test_durable_can_be_awaited_and_called_back(fake_map):
    told = []
    with publisher(fake_map, on_durable=told.append) as robot:
        futures = [robot.durable(robot.publish(SCAN)) for _ in range(5)]

        async def wait():
            return await asyncio.gather(*map(asyncio.wrap_future, futures))

        assert asyncio.run(wait()) == [1, 2, 3, 4, 5]
        assert robot.durable(2).result(0.0) == 2, "long done"
    assert told == [1, 2, 3, 4, 5]


def test_an_await_that_timed_out_keeps_nobody_from_hearing(silent_map):
    told = []

    async def impatient(robot, number):
        with pytest.raises(TimeoutError):
            await asyncio.wait_for(asyncio.wrap_future(robot.durable(number)), 0.01)

    with publisher(silent_map, on_durable=told.append) as robot:
        numbers = [robot.publish(SCAN) for _ in range(3)]
        patient = [robot.durable(number) for number in numbers]
        asyncio.run(impatient(robot, 1))
        assert patient[1].cancel()
        silent_map.subscribe()
        silent_map.appear()
        assert [patient[0].result(20.0), patient[2].result(20.0)] == [1, 3]
        assert robot.drain(20.0)
        assert told == [1, 2, 3]


def test_a_callback_that_fails_keeps_nobody_from_hearing(fake_map):
    told = []

    def on_durable(number: int) -> None:
        told.append(number)
        raise RuntimeError

    with publisher(fake_map, on_durable=on_durable) as robot:
        robot.publish(SCAN)
        assert robot.drain(20.0)
        fake_map.drop_every = 1
        future = [robot.durable(robot.publish(SCAN)) for _ in range(5)][-1]
        fake_map.acknowledge("r1", robot.boot, 6)
        assert future.result(20.0) == 6
    assert told == [1, 2, 3, 4, 5, 6]


def test_who_is_told_may_publish_though_the_outbox_is_full_and_others_wait(silent_map):
    settings = OutboxSettings(scans_max=1, window=1, silence_s=0.1)
    with publisher(silent_map, outbox=settings) as robot:
        first = robot.durable(robot.publish(replace(SCAN, stamp_ns=1)))
        first.add_done_callback(lambda _: robot.publish(replace(SCAN, stamp_ns=3)))
        other = threading.Thread(target=robot.publish, args=(replace(SCAN, stamp_ns=2),))
        other.start()
        silent_map.subscribe()
        silent_map.appear()
        silent_map.wait(3)
        other.join()
        assert robot.drain(20.0)
    assert sorted(stamps(silent_map)) == [1, 2, 3]


@pytest.mark.usefixtures("leaves_soon")
def test_dropping_a_scan_that_nobody_awaits_any_more(silent_map):
    settings = OutboxSettings(scans_max=2, window=1, policy="drop_oldest")
    with publisher(silent_map, outbox=settings) as robot:
        futures = [robot.durable(robot.publish(SCAN)) for _ in range(2)]
        assert futures[0].cancel()
        for _ in range(2):
            robot.publish(SCAN)
        for future in (futures[1], robot.durable(1)):
            with pytest.raises(ScanDroppedError):
                future.result(20.0)


def test_only_scans_that_were_published_can_be_stored(fake_map):
    with publisher(fake_map) as robot:
        with pytest.raises(UnknownScanError, match="none was published yet"):
            robot.durable(1)
        for _ in range(3):
            robot.publish(SCAN)
        for number in (99, 4, 0, -1):
            with pytest.raises(ValueError, match=f"no scan {number} .* from 1 to 3"):
                robot.durable(number)


@pytest.mark.usefixtures("leaves_soon")
def test_who_waits_is_told_that_the_publisher_was_closed(silent_map):
    with publisher(silent_map) as robot:
        future = robot.durable(robot.publish(SCAN))
    with pytest.raises(DeliveryError, match="was closed before"):
        future.result(0.0)


def test_best_effort_cannot_tell(fake_map):
    with (
        publisher(fake_map, reliable=False) as robot,
        pytest.raises(DeliveryError, match="best-effort"),
    ):
        robot.durable(1)


@pytest.mark.usefixtures("leaves_soon")
def test_a_full_outbox_blocks_or_says_so(silent_map):
    settings = OutboxSettings(scans_max=3, window=3, block_timeout_s=0.1)
    with publisher(silent_map, outbox=settings) as robot:
        for _ in range(3):
            robot.publish(SCAN)
        with pytest.raises(OutboxFullError, match="3 scans"):
            robot.publish(SCAN)
        assert robot.waiting == 3


def test_the_oldest_unsent_scans_make_room_and_are_counted(silent_map):
    settings = OutboxSettings(scans_max=4, window=2, policy="drop_oldest", silence_s=0.1)
    with publisher(silent_map, outbox=settings) as robot:
        futures = []
        for i in range(10):
            robot.publish(replace(SCAN, stamp_ns=i))
            futures.append(robot.durable(robot.seq))
        assert (robot.waiting, robot.dropped) == (4, 6)
        silent_map.subscribe()
        silent_map.appear()
        assert robot.drain(20.0)
    assert stamps(silent_map) == [6, 7, 8, 9]
    assert [scan.seq for scan in silent_map.scans()] == [1, 2, 3, 4], "the stream has no gap"
    with pytest.raises(ScanDroppedError):
        futures[0].result(0.0)
    assert futures[9].result(0.0) == 10


@pytest.mark.usefixtures("leaves_soon")
def test_scans_are_bounded_in_bytes_too(silent_map):
    settings = OutboxSettings(bytes_max=4000, policy="drop_oldest")
    with publisher(silent_map, outbox=settings) as robot:
        for _ in range(5):
            robot.publish(SCAN)  # 1560 bytes
        assert robot.waiting == 2


def test_a_map_that_forgot_gets_what_waits_as_a_new_stream(fake_map):
    with publisher(fake_map) as robot:
        robot.publish(replace(SCAN, stamp_ns=1))
        assert robot.drain(20.0)
        first = robot.boot
        fake_map.stored.clear()
        robot.publish(replace(SCAN, stamp_ns=2))
        assert robot.drain(20.0)
        assert robot.boot > first
    assert [(scan.seq, scan.stamp_ns) for scan in fake_map.scans()] == [(1, 1), (1, 2)]


def test_a_clock_that_was_set_back_does_not_stop_a_robot(fake_map):
    for boot in (1000, 5):
        with publisher(fake_map, clock_ns=lambda boot=boot: boot) as robot:
            robot.publish(SCAN)
            assert robot.drain(20.0)
    assert [scan.boot for scan in fake_map.scans()] == [1000, 1001]


def test_of_two_robots_with_one_name_the_older_is_told(fake_map):
    with publisher(fake_map) as older:
        older.publish(SCAN)
        assert older.drain(20.0)
        with publisher(fake_map) as newer:
            newer.publish(SCAN)
            assert newer.drain(20.0)

            def go_on() -> None:
                end = time.monotonic() + 10.0
                while time.monotonic() < end:
                    older.publish(SCAN)
                    time.sleep(0.02)

            with pytest.raises(SupersededError, match="two robots have the same name"):
                go_on()
            newer.publish(SCAN)
            assert newer.drain(20.0)


@pytest.mark.usefixtures("leaves_soon")
def test_what_waits_fails_at_once_when_another_takes_over(fake_map):
    with publisher(fake_map) as older:
        older.publish(SCAN)
        assert older.drain(20.0)
        fake_map.drop_every = 1
        number = older.publish(SCAN)
        future = older.durable(number)
        fake_map.acknowledge("r1", older.boot + 1, 1)
        assert isinstance(future.exception(20.0), SupersededError)
        for late in (older.durable(number), older.durable(number)):
            with pytest.raises(SupersededError, match="1 scans of this one are not stored"):
                late.result(0.0)
        assert older.durable(1).result(0.0) == 1, "it was stored before"
        with pytest.raises(SupersededError):
            older.publish(SCAN)


def test_a_restarted_map_that_kept_its_journal_goes_on(fake_map):
    with running_map() as first:
        endpoint = first.endpoint
        robot = publisher(first).__enter__()
        for i in range(10):
            robot.publish(replace(SCAN, stamp_ns=i))
        assert robot.drain(20.0)
        stored = dict(first.stored)
    for i in range(10, 20):
        robot.publish(replace(SCAN, stamp_ns=i))
    with running_map(endpoint, silent=True) as second:
        second.stored.update(stored)
        second.subscribe()
        second.appear()
        assert robot.drain(20.0)
        assert [scan.seq for scan in second.scans()] == list(range(11, 21))
        robot.__exit__(None, None, None)


def test_a_robot_that_crashed_goes_on_from_its_disk(silent_map, tmp_path):
    settings = OutboxSettings(path=tmp_path / "outbox", silence_s=0.1)
    robot = publisher(silent_map, outbox=settings).__enter__()
    for i in range(5):
        robot.publish(replace(SCAN, stamp_ns=i))
    boot = robot.boot
    robot.__exit__(RuntimeError, RuntimeError(), None)  # nobody waits
    silent_map.subscribe()
    silent_map.appear()
    with publisher(silent_map, outbox=settings) as robot:
        robot.publish(replace(SCAN, stamp_ns=5))
        assert robot.durable(5).result(20.0) == 5
        assert robot.drain(20.0)
        assert robot.boot == boot
    assert stamps(silent_map) == [0, 1, 2, 3, 4, 5]
    assert [scan.seq for scan in silent_map.scans()] == [1, 2, 3, 4, 5, 6]
