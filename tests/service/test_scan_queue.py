import threading

import pytest
from hypothesis import given
from hypothesis import strategies as st

from service.scan_queue import ScanQueue
from service.source import Envelope


def _envelope(number: int, size: int = 8) -> Envelope:
    return Envelope("r", "s", bytes([number % 256]) * size, 0.0)


def _numbers(envelopes: list[Envelope]) -> list[int]:
    return [envelope.payload[0] for envelope in envelopes]


def test_first_in_first_out_with_tickets() -> None:
    queue = ScanQueue("block", 10, 1000)
    for number in range(5):
        assert queue.put(_envelope(number))
    taken, ticket = queue.take(2)
    assert (_numbers(taken), ticket) == ([0, 1], 2)
    taken, ticket = queue.take(10)
    assert (_numbers(taken), ticket) == ([2, 3, 4], 5)
    assert queue.entered == queue.received == 5


@pytest.mark.parametrize(
    ("policy", "kept", "entered"), [("drop_oldest", [3, 4], 5), ("drop_newest", [0, 1], 2)]
)
def test_full_queue_drops_by_policy(policy, kept, entered) -> None:
    queue = ScanQueue(policy, 2, 1000)
    for number in range(5):
        queue.put(_envelope(number))
    taken, ticket = queue.take(10)
    assert _numbers(taken) == kept
    assert ticket == queue.entered == entered
    assert (queue.received, queue.dropped) == (5, 3)


def test_full_queue_blocks_until_there_is_room() -> None:
    queue = ScanQueue("block", 1, 1000)
    queue.put(_envelope(0))
    done = threading.Event()

    def put() -> None:
        queue.put(_envelope(1))
        done.set()

    thread = threading.Thread(target=put)
    thread.start()
    assert not done.wait(0.05)
    assert _numbers(queue.take(1)[0]) == [0]
    assert done.wait(5.0)
    thread.join()
    assert queue.dropped == 0


def test_closing_releases_who_is_blocked_and_who_waits() -> None:
    queue = ScanQueue("block", 1, 1000)
    queue.put(_envelope(0))
    put = threading.Thread(target=queue.put, args=(_envelope(1),))
    put.start()
    queue.close()
    put.join(5.0)
    assert not put.is_alive()
    assert _numbers(queue.take(10)[0]) == [0], "what is inside can still be taken"
    assert queue.take(10)[0] == []
    assert not queue.put(_envelope(2))


def test_bytes_are_bounded_but_one_large_scan_always_fits() -> None:
    queue = ScanQueue("drop_newest", 100, 20)
    assert queue.put(_envelope(0, size=50))
    assert not queue.put(_envelope(1, size=1))
    queue.take(1)
    assert queue.put(_envelope(2, size=10))
    assert queue.put(_envelope(3, size=10))
    assert not queue.put(_envelope(4, size=1))


@given(
    policy=st.sampled_from(["drop_oldest", "drop_newest"]),
    steps=st.lists(st.one_of(st.integers(1, 30), st.just("take")), max_size=60),
)
def test_nothing_is_lost_uncounted_and_bounds_hold(policy, steps) -> None:
    queue = ScanQueue(policy, 5, 60)
    taken = 0
    for step in steps:
        if step == "take":
            if len(queue):
                envelopes, ticket = queue.take(2)
                taken += len(envelopes)
                assert ticket == queue.entered - len(queue)
        else:
            queue.put(_envelope(0, step))
        assert len(queue) <= 5
        assert queue.received == taken + queue.dropped + len(queue)
