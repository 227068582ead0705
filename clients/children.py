"""Processes of one command that live no longer than it does."""

import signal
import subprocess
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from threading import Event
from types import FrameType, TracebackType
from typing import Self

from gpom_core.errors import GpomError

_LAST_LINES = 15
_STOP_SIGNALS = ("SIGINT", "SIGTERM", "SIGHUP")


class ChildFailedError(GpomError):
    """A process that this command depends on has ended by itself."""

    exit_code = 1


class Child:
    """A running process whose output goes to a file; the end of the ``with`` block ends it.

    Args:
        name: what messages call it.
        command: program and arguments.
        log: file for all that it prints.
        stop_timeout_s: how long it may take to end before it is killed.
    """

    def __init__(
        self, name: str, command: Sequence[str], log: Path, *, stop_timeout_s: float = 15.0
    ) -> None:
        self.name = name
        self._log = log
        self._stop_timeout_s = stop_timeout_s
        with log.open("wb") as output:
            # In a session of its own, Ctrl-C reaches this command alone, which ends the
            # children one after the other.
            self._process = subprocess.Popen(  # noqa: S603 - our own commands, no shell
                command,
                stdin=subprocess.DEVNULL,
                stdout=output,
                stderr=subprocess.STDOUT,
                start_new_session=True,
            )

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self.stop()

    @property
    def pid(self) -> int:
        """Number of the process."""
        return self._process.pid

    def is_running(self) -> bool:
        """Whether it still runs.

        Raises:
            ChildFailedError: it ended with an error; the message has its last words.
        """
        code = self._process.poll()
        if code:
            raise ChildFailedError(self._obituary())
        return code is None

    def must_run(self) -> None:
        """Check that it still runs.

        Raises:
            ChildFailedError: it ended, well or not.
        """
        if not self.is_running():
            raise ChildFailedError(self._obituary())

    def stop(self) -> None:
        """Ask it to end, wait, and kill it if it does not listen."""
        self._process.terminate()  # does nothing when it has ended
        try:
            self._process.wait(self._stop_timeout_s)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()

    def _obituary(self) -> str:
        lines = self._log.read_text(encoding="utf-8", errors="replace").splitlines()
        last_words = "\n  ".join(lines[-_LAST_LINES:]) or "(it said nothing)"
        return f"`{self.name}` ended with exit code {self._process.returncode}:\n  {last_words}"


@contextmanager
def stop_on_signal() -> Iterator[Event]:
    """Give an event that Ctrl-C, SIGTERM and a closed terminal set, in the main thread only."""
    stop = Event()

    def handle(_number: int, _frame: FrameType | None) -> None:
        stop.set()

    numbers = [getattr(signal, name) for name in _STOP_SIGNALS if hasattr(signal, name)]
    previous = {number: signal.signal(number, handle) for number in numbers}
    try:
        yield stop
    finally:
        for number, handler in previous.items():
            signal.signal(number, handler)
