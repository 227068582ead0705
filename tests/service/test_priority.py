"""Threads that give way, and those that do not."""

import os
import sys
from concurrent.futures import ThreadPoolExecutor

import pytest

from service.priority import be_nice
from service.query_desk import QueryDesk

pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="priorities of threads")


def niceness():
    return os.getpriority(os.PRIO_PROCESS, 0)


def test_only_the_thread_that_asks_gives_way():
    before = niceness()
    with ThreadPoolExecutor(1, initializer=be_nice, initargs=(3,)) as pool:
        assert pool.submit(niceness).result() == min(before + 3, 19)
    assert niceness() == before


def test_heavy_queries_give_way_to_what_is_quick():
    desk = QueryDesk(1, 1, 1)
    assert desk.submit(niceness).result() > niceness()
    desk.close()
