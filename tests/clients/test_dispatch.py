"""Scans leave on time, none is left out, and losses are told."""

import itertools
import time
from dataclasses import replace
from threading import Event, Timer

import numpy as np
import pytest

from clients import dispatch as dispatch_module
from clients.dispatch import Departure, await_map, dispatch
from clients.errors import DeliveryError
from gpom_core.scan import Pose2D, Scan

SCAN = Scan(Pose2D(0.0, 0.0, 0.0), np.ones(2, np.float32), 0.0, 1.0, 0.1, 10.0)


class FakeSender:
    """A publisher in memory."""

    def __init__(self, *, ready=True, drains=True, reliable=False):
        self.reliable = reliable
        self.ready = ready
        self.drains = drains
        self.interruptions = 0
        self.sent = []
        self.times = []

    def wait_ready(self, timeout_s=0.0):
        if not self.ready:
            raise DeliveryError("no map service is alive")

    def publish(self, scan):
        self.sent.append(scan)
        self.times.append(time.monotonic())
        return len(self.sent)

    def drain(self, timeout_s=0.0):
        return self.drains


def departures(*dues, robot=0):
    return [Departure(due, robot, replace(SCAN, stamp_ns=i)) for i, due in enumerate(dues)]


def test_everything_is_sent_in_order_and_counted():
    senders = [FakeSender(), FakeSender()]
    told = []
    plan = [Departure(0.0, i % 2, replace(SCAN, stamp_ns=i)) for i in range(9)]
    report = dispatch(plan, senders, stop=Event(), timeout_s=1.0, on_sent=told.append)
    assert report.sent == (5, 4)
    assert [scan.stamp_ns for scan in senders[1].sent] == [1, 3, 5, 7]
    assert told == plan
    assert report.drained
    assert not report.stopped
    assert report.interruptions == 0


def test_scans_wait_until_they_are_due():
    sender = FakeSender()
    report = dispatch(departures(0.0, 0.05, 0.1), [sender], stop=Event(), timeout_s=1.0)
    gaps = np.diff(sender.times)
    assert (gaps > 0.02).all()
    assert report.elapsed_s >= 0.1


def test_late_scans_are_sent_and_the_delay_is_told():
    sender = FakeSender()

    def late():
        yield from departures(0.0)
        time.sleep(0.2)
        yield from departures(0.05, 0.06)

    report = dispatch(late(), [sender], stop=Event(), timeout_s=1.0)
    assert report.sent == (3,)
    assert report.most_late_s > 0.1


def test_a_stop_ends_endless_departures_while_they_wait():
    stop = Event()
    Timer(0.1, stop.set).start()
    endless = (Departure(i * 0.01, 0, SCAN) for i in itertools.count())
    report = dispatch(endless, [FakeSender()], stop=stop, timeout_s=1.0)
    assert report.stopped
    assert 0 < report.sent[0] < 50


def test_a_map_that_comes_back_in_time_is_waited_for():
    sender = FakeSender(ready=False)
    Timer(0.1, lambda: setattr(sender, "ready", True)).start()
    assert dispatch(departures(0.0), [sender], stop=Event(), timeout_s=10.0).sent == (1,)


def test_a_map_that_stays_away_is_an_error():
    sender = FakeSender()

    def then_gone():
        yield from departures(0.0, 0.0)
        sender.ready = False
        yield from departures(0.0)

    with pytest.raises(DeliveryError, match=r"went away after 2 scans.*no map service is alive"):
        dispatch(then_gone(), [sender], stop=Event(), timeout_s=0.1)


def test_a_stop_also_ends_the_wait_for_a_map():
    stop = Event()
    stop.set()
    started = time.monotonic()
    assert not await_map([FakeSender(ready=False)], 30.0, stop)
    assert time.monotonic() - started < 5.0


def test_possible_losses_are_told(monkeypatch):
    monkeypatch.setattr(dispatch_module, "DRAIN_TIMEOUT_S", 0.05)
    stuck = FakeSender(drains=False)
    report = dispatch(departures(0.0), [stuck, FakeSender()], stop=Event(), timeout_s=1.0)
    assert not report.drained
    shaky = FakeSender()
    shaky.interruptions = 2
    report = dispatch(departures(0.0), [shaky], stop=Event(), timeout_s=1.0)
    assert (report.drained, report.interruptions) == (True, 2)
