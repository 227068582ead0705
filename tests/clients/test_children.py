"""Children end when their command does, and say why when they end before."""

import os
import signal
import sys
import time
from pathlib import Path

import pytest

from clients.children import Child, ChildFailedError, stop_on_signal

SLEEP = [sys.executable, "-c", "import time; print('here', flush=True); time.sleep(60)"]
DEAF = [*SLEEP[:2], "import signal; signal.signal(signal.SIGTERM, signal.SIG_IGN);" + SLEEP[2]]


def wait_for_words(log: Path, timeout_s: float = 20.0) -> None:
    end = time.monotonic() + timeout_s
    while not log.read_text() and time.monotonic() < end:
        time.sleep(0.02)
    assert log.read_text()


def wait_for_end(child: Child) -> None:
    while child.is_running():
        time.sleep(0.02)


def is_alive(pid: int) -> bool:
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    return True


@pytest.mark.parametrize("command", [SLEEP, DEAF], ids=["willing", "deaf"])
def test_the_end_of_the_block_ends_the_child(command: list[str], tmp_path: Path) -> None:
    with Child("sleep", command, tmp_path / "log", stop_timeout_s=0.5) as child:
        wait_for_words(tmp_path / "log")
        assert child.is_running()

    assert not is_alive(child.pid)


def test_an_error_ends_the_child_too(tmp_path: Path) -> None:
    with pytest.raises(ZeroDivisionError), Child("sleep", SLEEP, tmp_path / "log") as child:
        raise ZeroDivisionError

    assert not is_alive(child.pid)


def test_a_child_that_fails_gives_its_last_words(tmp_path: Path) -> None:
    command = [sys.executable, "-c", "import sys; sys.exit('the port is taken')"]

    with (
        Child("serve", command, tmp_path / "log") as child,
        pytest.raises(ChildFailedError, match=r"(?s)serve.*exit code 1.*the port is taken"),
    ):
        wait_for_end(child)


def test_a_child_that_ends_well_has_just_ended(tmp_path: Path) -> None:
    with Child("done", [sys.executable, "-c", "print('bye')"], tmp_path / "log") as child:
        wait_for_end(child)

        with pytest.raises(ChildFailedError, match=r"(?s)done.*exit code 0.*bye"):
            child.must_run()


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
def test_signals_are_heard_inside_the_block_only(number: signal.Signals) -> None:
    before = signal.getsignal(number)

    with stop_on_signal() as stop:
        assert not stop.is_set()
        os.kill(os.getpid(), number)
        assert stop.wait(5.0)

    assert signal.getsignal(number) is before
