"""Whoever asked is told once, in order, whatever others who asked do."""

import threading
from concurrent.futures import CancelledError, Future

import pytest

from clients.errors import ScanDroppedError, SupersededError, UnknownScanError
from clients.receipts import Receipts

PATIENCE_S = 20.0


@pytest.fixture
def opened():
    """Makes receipts that are closed at the end."""
    made = []

    def build(on_durable=None, **options) -> Receipts:
        made.append(Receipts("r1/laser", on_durable=on_durable, **options))
        return made[-1]

    yield build
    for receipts in made:
        receipts.close(PATIENCE_S)


def test_who_gave_up_keeps_nobody_from_hearing(opened):
    told = []
    receipts = opened(told.append)
    futures = [receipts.promise(ticket) for ticket in (1, 2, 3)]
    assert futures[0].cancel()
    receipts.stored([1, 2, 3])
    receipts.wait(PATIENCE_S)
    assert [future.result(0.0) for future in futures[1:]] == [2, 3]
    assert told == [1, 2, 3]


def test_a_future_that_somebody_else_completed_keeps_nobody_from_hearing(opened):
    receipts = opened()
    meddled, other = receipts.promise(1), receipts.promise(2)
    meddled.set_result(77)
    receipts.stored([1, 2])
    assert other.result(PATIENCE_S) == 2
    assert meddled.result(0.0) == 77


def test_whether_cancelled_or_told_is_settled_once(opened):
    """A cancellation at the same moment wins or loses, and breaks nothing."""
    receipts = opened()
    for start in range(0, 2000, 100):
        tickets = range(start, start + 100)
        futures = [receipts.promise(ticket) for ticket in tickets]
        receipts.stored(tickets)
        won = [future.cancel() for future in futures]
        for ticket, future, cancelled in zip(tickets, futures, won, strict=True):
            if cancelled:
                with pytest.raises(CancelledError):
                    future.result(0.0)
            else:
                assert future.result(PATIENCE_S) == ticket


def test_all_who_ask_about_one_scan_are_told(opened):
    receipts = opened()
    first, second, third = (receipts.promise(1) for _ in range(3))
    assert second.cancel()
    receipts.stored([1])
    assert first.result(PATIENCE_S) == third.result(PATIENCE_S) == 1


@pytest.mark.parametrize("error", [ValueError("no"), SystemExit(3)])
def test_a_callback_that_fails_is_logged_and_called_again(opened, caplog, error):
    told = []

    def fail_on_the_second(ticket: int) -> None:
        told.append(ticket)
        if ticket == 2:
            raise error

    receipts = opened(fail_on_the_second)
    future = receipts.promise(3)
    receipts.stored([1, 2, 3])
    assert future.result(PATIENCE_S) == 3
    receipts.wait(PATIENCE_S)
    assert told == [1, 2, 3]
    (record,) = (record for record in caplog.records if record.name == "clients.receipts")
    assert "scan 2 of r1/laser" in record.getMessage()
    assert record.exc_info[1] is error


def test_who_asked_first_hears_before_the_callback_and_scans_keep_their_order(opened):
    heard = []
    receipts = opened(lambda ticket: heard.append(("callback", ticket)))
    for ticket in (2, 1):
        receipts.promise(ticket).add_done_callback(
            lambda future: heard.append(("future", future.result()))
        )
    receipts.stored([1])
    receipts.stored([2])
    receipts.wait(PATIENCE_S)
    assert heard == [("future", 1), ("callback", 1), ("future", 2), ("callback", 2)]


def test_nobody_who_tells_news_is_held_up_by_who_hears_them(opened):
    go_on = threading.Event()
    receipts = opened(lambda _: go_on.wait(PATIENCE_S))
    receipts.stored([1])
    future = receipts.promise(2)
    receipts.stored([2])  # comes back while the callback waits
    assert not future.done()
    go_on.set()
    assert future.result(PATIENCE_S) == 2


def test_who_is_told_may_ask_wait_and_close(opened):
    later: Future[Future[int]] = Future()

    def on_durable(ticket: int) -> None:
        if ticket == 1:
            later.set_result(receipts.promise(2))
            receipts.wait(PATIENCE_S)
            receipts.fail_all(SupersededError("somebody else"))
            receipts.close(PATIENCE_S)

    receipts = opened(on_durable)
    receipts.stored([1])
    with pytest.raises(SupersededError, match="somebody else"):
        later.result(PATIENCE_S).result(PATIENCE_S)


def test_all_who_wait_are_told_of_a_failure_each_by_an_error_of_its_own(opened):
    receipts = opened()
    futures = [receipts.promise(ticket) for ticket in (1, 2)]
    receipts.fail_all(SupersededError("somebody else"))
    errors = [future.exception(PATIENCE_S) for future in futures]
    assert [str(error) for error in errors] == ["somebody else"] * 2
    assert {type(error) for error in errors} == {SupersededError}
    assert errors[0] is not errors[1], "a traceback grows with every raise"


def test_a_scan_of_the_past_was_stored_or_dropped(opened):
    receipts = opened()
    waiting = receipts.promise(2)
    receipts.dropped(2)
    with pytest.raises(ScanDroppedError, match="scan 2"):
        waiting.result(PATIENCE_S)
    assert receipts.past(1, first=1, last=3).result(0.0) == 1
    with pytest.raises(ScanDroppedError, match="scan 2"):
        receipts.past(2, first=1, last=3).result(0.0)


@pytest.mark.parametrize(
    ("number", "message"),
    [(0, "from 1 to 3"), (-1, "from 1 to 3"), (99, "no scan 99 is known here; .* from 1 to 3")],
)
def test_a_number_that_no_scan_has_is_refused(opened, number, message):
    with pytest.raises(UnknownScanError, match=message):
        opened().past(number, first=1, last=3)
    with pytest.raises(ValueError, match="none was published yet"):
        opened().past(number, first=1, last=0)


def test_what_became_of_scans_before_is_not_known(opened):
    """Those of an earlier run, and dropped ones beyond the memory for them."""
    receipts = opened(before=5, dropped=[7])
    with pytest.raises(UnknownScanError, match="from 6 to 9"):
        receipts.past(5, first=8, last=9)
    assert receipts.past(6, first=8, last=9).result(0.0) == 6
    with pytest.raises(ScanDroppedError):
        receipts.past(7, first=8, last=9).result(0.0)
    receipts = opened(remembered=2)
    for ticket in (2, 4, 6):
        receipts.dropped(ticket)
    assert receipts.past(3, first=8, last=9).result(0.0) == 3
    assert receipts.past(4, first=8, last=9).exception(0.0) is not None
    for ticket in (1, 2):
        with pytest.raises(UnknownScanError, match="from 3 to 9"):
            receipts.past(ticket, first=8, last=9)
