"""Time, as a port: the process reads it here, so tests can set it."""

import time
from typing import Protocol


class Clock(Protocol):
    """Where the service gets the time from."""

    def unix_s(self) -> float:
        """Seconds since the epoch."""

    def monotonic_s(self) -> float:
        """Seconds since some moment, never going back."""


class SystemClock:
    """The clocks of the machine."""

    def unix_s(self) -> float:
        """Seconds since the epoch."""
        return time.time()

    def monotonic_s(self) -> float:
        """Seconds since some moment, never going back."""
        return time.monotonic()


class ManualClock:
    """A clock that moves only when told."""

    def __init__(self, unix_s: float = 1_000_000_000.0) -> None:
        self._start_unix_s = unix_s
        self._elapsed_s = 0.0

    def advance(self, seconds: float) -> None:
        """Let time pass."""
        if seconds < 0.0:
            raise ValueError(f"time does not go back, got {seconds} s")
        self._elapsed_s += seconds

    def unix_s(self) -> float:
        """Seconds since the epoch."""
        return self._start_unix_s + self._elapsed_s

    def monotonic_s(self) -> float:
        """Seconds since some moment, never going back."""
        return self._elapsed_s
