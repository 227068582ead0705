from hypothesis import given
from hypothesis import strategies as st

from service.sequences import SILENCE_S, Cursor, SensorKey, SequenceBook, Verdict
from tests.service.rooms import scan_at

KEY = SensorKey("robot", "front")


def _judge(
    book: SequenceBook, *numbers: tuple[int, int], now_s: float = 0.0
) -> list[tuple[Verdict, int]]:
    admission = book.begin(now_s)
    judged = [admission.judge(KEY, scan_at(boot=boot, seq=seq)) for boot, seq in numbers]
    admission.commit()
    return [(judgement.verdict, judgement.lost) for judgement in judged]


def test_a_stream_may_be_joined_anywhere() -> None:
    assert _judge(SequenceBook(), (1, 57)) == [(Verdict.NEW, 0)]


def test_gaps_are_counted_and_repeats_are_stale() -> None:
    judged = _judge(SequenceBook(), (1, 1), (1, 2), (1, 2), (1, 5), (1, 4), (1, 6))
    new, stale = (Verdict.NEW, 0), (Verdict.STALE, 0)
    assert judged == [new, new, stale, (Verdict.NEW, 2), stale, new]


def test_a_new_run_starts_at_one_and_ends_the_old_one() -> None:
    judged = _judge(SequenceBook(), (1, 9), (2, 3), (1, 10))
    assert judged == [(Verdict.NEW, 0), (Verdict.NEW, 2), (Verdict.OLD_RUN, 0)]


def test_a_clock_set_back_is_followed_once_the_last_run_is_silent() -> None:
    book = SequenceBook()
    new, old = (Verdict.NEW, 0), (Verdict.OLD_RUN, 0)
    assert _judge(book, (100, 7)) == [new]
    assert _judge(book, (50, 1), (50, 2), now_s=SILENCE_S - 0.1) == [old, old]
    assert _judge(book, (50, 4), (50, 5), now_s=SILENCE_S) == [new, new]
    assert book.cursor(KEY) == Cursor(101, 5), "the runs stay in order"
    assert _judge(book, (100, 8), (50, 5), now_s=SILENCE_S) == [old, (Verdict.STALE, 0)]
    assert _judge(book, (50, 7), (100, 9), now_s=2 * SILENCE_S) == [(Verdict.NEW, 1), old]
    assert _judge(book, (200, 1), (50, 8), now_s=2 * SILENCE_S) == [new, old]


def test_what_was_heard_before_the_service_counts_as_heard_at_its_start() -> None:
    book = SequenceBook({KEY: Cursor(100, 7)}, now_s=1000.0)
    assert _judge(book, (50, 1), now_s=1001.0) == [(Verdict.OLD_RUN, 0)]
    assert _judge(book, (100, 9), now_s=1001.0) == [(Verdict.NEW, 1)]
    assert _judge(book, (50, 2), now_s=1001.0 + SILENCE_S) == [(Verdict.NEW, 0)]
    assert book.cursor(KEY) == Cursor(101, 2)


def test_a_repeat_never_becomes_a_new_run() -> None:
    book = SequenceBook()
    _judge(book, (1, 9))
    assert _judge(book, (1, 9), (1, 3), now_s=1e6) == [(Verdict.STALE, 0)] * 2


def test_unnumbered_scans_are_always_new() -> None:
    assert _judge(SequenceBook(), (0, 0), (0, 0)) == [(Verdict.NEW, 0)] * 2


def test_sensors_do_not_share_numbers() -> None:
    admission = SequenceBook().begin()
    for sensor in ("front", "rear"):
        judgement = admission.judge(SensorKey("robot", sensor), scan_at(seq=1))
        assert judgement.verdict is Verdict.NEW
    assert set(admission.cursors.values()) == {Cursor(1, 1)}


def test_a_batch_that_is_dropped_was_never_seen() -> None:
    book = SequenceBook()
    assert book.begin().judge(KEY, scan_at(seq=1)).verdict is Verdict.NEW
    assert _judge(book, (1, 1)) == [(Verdict.NEW, 0)]


@given(st.lists(st.integers(1, 40), min_size=1), st.data())
def test_batches_do_not_matter_and_accepted_plus_lost_is_the_span(numbers, data) -> None:
    together = _judge(SequenceBook(), *((1, n) for n in numbers))
    cut = data.draw(st.integers(0, len(numbers)))
    book = SequenceBook()
    apart = _judge(book, *((1, n) for n in numbers[:cut]))
    apart += _judge(book, *((1, n) for n in numbers[cut:]))
    assert together == apart
    accepted = sum(verdict is Verdict.NEW for verdict, _ in together)
    lost = sum(lost for _, lost in together)
    assert accepted + lost == max(numbers) - numbers[0] + 1
