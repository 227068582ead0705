import asyncio

import pytest

from service.errors import BusyError, StoppingError
from service.events import EventBus, MapChanged, RobotChanged, union


async def _next(subscription, keepalive_s=5.0):
    async for batch in subscription.batches(keepalive_s):
        return batch
    return None


def test_union_of_boxes() -> None:
    assert union(None, None) is None
    assert union(None, (0, 0, 1, 1)) == (0, 0, 1, 1)
    assert union((0, 0, 1, 1), (-1, 0.5, 0.5, 3)) == (-1, 0, 1, 3)


def test_a_slow_reader_gets_the_newest_with_all_that_changed() -> None:
    async def scenario():
        bus = EventBus(2)
        with bus.subscribe() as subscription:
            bus.publish(MapChanged(1, (0.0, 0.0, 1.0, 1.0)))
            bus.publish(RobotChanged("a", True))
            bus.publish(MapChanged(2, (2.0, 0.0, 3.0, 1.0)))
            bus.publish(RobotChanged("a", False))
            return await _next(subscription)

    assert asyncio.run(scenario()) == [
        RobotChanged("a", False),
        MapChanged(2, (0.0, 0.0, 3.0, 1.0)),
    ]


def test_news_come_from_other_threads() -> None:
    async def scenario():
        bus = EventBus(1)
        with bus.subscribe() as subscription:
            publish = asyncio.to_thread(bus.publish, RobotChanged("a", True))
            batch, _ = await asyncio.gather(_next(subscription), publish)
            return batch

    assert asyncio.run(scenario()) == [RobotChanged("a", True)]


def test_silence_is_told() -> None:
    async def scenario():
        with EventBus(1).subscribe() as subscription:
            return await _next(subscription, keepalive_s=0.01)

    assert asyncio.run(scenario()) == []


def test_closing_ends_streams_and_refuses_new_ones() -> None:
    async def scenario():
        bus = EventBus(1)
        with bus.subscribe() as subscription:
            asyncio.get_running_loop().call_later(0.01, bus.close)
            assert await _next(subscription) is None
        with pytest.raises(StoppingError):
            bus.subscribe()

    asyncio.run(scenario())


def test_readers_are_bounded() -> None:
    async def scenario():
        bus = EventBus(1)
        with bus.subscribe(), pytest.raises(BusyError):
            bus.subscribe()
        assert bus.clients == 0
        with bus.subscribe():
            assert bus.clients == 1

    asyncio.run(scenario())


def test_publishing_to_a_loop_that_is_gone_is_harmless() -> None:
    bus = EventBus(1)

    async def leave_open():
        bus.subscribe()

    asyncio.run(leave_open())
    bus.publish(RobotChanged("a", True))
