import threading

import pytest

from service.errors import BusyError, StoppingError
from service.query_desk import QueryDesk


def test_more_than_it_takes_is_refused_at_once() -> None:
    desk = QueryDesk(threads=1, waiting_max=1, retry_after_s=7)
    release = threading.Event()
    try:
        running = desk.submit(release.wait)
        waiting = desk.submit(lambda: "done")
        with pytest.raises(BusyError) as refused:
            desk.submit(lambda: None)
        assert refused.value.retry_after_s == 7
        release.set()
        assert waiting.result(5.0) == "done"
        assert running.result(5.0)
        assert desk.submit(lambda: 1).result(5.0) == 1, "there is room again"
    finally:
        release.set()
        desk.close()


def test_long_calls_end_with_the_desk() -> None:
    desk = QueryDesk(threads=1, waiting_max=0, retry_after_s=1)
    desk.check()

    def long() -> None:
        while True:
            desk.check()

    future = desk.submit(long)
    desk.close()
    with pytest.raises(StoppingError):
        future.result(5.0)


def test_errors_reach_the_caller_and_free_the_place(eventually) -> None:
    desk = QueryDesk(threads=1, waiting_max=0, retry_after_s=1)

    def fail() -> None:
        raise KeyError("x")

    for _ in range(3):
        future = desk.submit(fail)
        with pytest.raises(KeyError):
            future.result(5.0)
        eventually(lambda: not desk.taken)
    desk.close()
    with pytest.raises(StoppingError):
        desk.submit(fail)
    assert desk.taken == 0
