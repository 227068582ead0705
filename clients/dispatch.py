"""Scans of several robots, each sent when it is due."""

import time
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from threading import Event
from typing import NamedTuple, Protocol

from clients.errors import DeliveryError
from gpom_core.scan import Scan

DRAIN_TIMEOUT_S = 120.0
"""How long a busy service may take for what is under way at the end."""

_POLL_S = 0.05
_DRAIN_POLL_S = 2.0


class Departure(NamedTuple):
    """A scan with the time to send it.

    Attributes:
        due_s: after the first.
        robot: whose scan it is, as an index into the publishers.
        scan: to send.
    """

    due_s: float
    robot: int
    scan: Scan


class Sender(Protocol):
    """What dispatch needs of a publisher."""

    @property
    def ready(self) -> bool:
        """Whether a map service receives."""
        ...

    @property
    def reliable(self) -> bool:
        """Whether scans are kept until the map has them."""
        ...

    @property
    def interruptions(self) -> int:
        """How often reception ended."""
        ...

    def wait_ready(self, timeout_s: float = ...) -> None:
        """Wait until a map service receives, or raise DeliveryError."""
        ...

    def publish(self, scan: Scan) -> int:
        """Send a scan."""
        ...

    def drain(self, timeout_s: float = ...) -> bool:
        """Wait until everything sent is through."""
        ...


@dataclass(frozen=True, slots=True)
class Report:
    """What came of a dispatch.

    Attributes:
        sent: scans per robot.
        elapsed_s: from the first to the end of the last.
        most_late_s: how far the latest scan was behind its time; 0 when none was due later.
        interruptions: how often a robot lost the map service, and scans may have been lost by it.
        drained: whether all scans have left this machine.
        stopped: whether it was told to stop before the end.
    """

    sent: tuple[int, ...]
    elapsed_s: float
    most_late_s: float
    interruptions: int
    drained: bool
    stopped: bool


def await_map(senders: Iterable[Sender], timeout_s: float, stop: Event) -> bool:
    """Wait until the map service receives from every sender.

    Returns:
        False when told to stop before that.

    Raises:
        DeliveryError: it does not within `timeout_s`.
    """
    end = time.monotonic() + timeout_s
    for sender in senders:
        # In short waits, so that a signal is heard.
        while not sender.ready and time.monotonic() < end:
            if stop.wait(_POLL_S):
                return False
        sender.wait_ready(0.0)
    return True


def dispatch(
    departures: Iterable[Departure],
    senders: Sequence[Sender],
    *,
    stop: Event,
    timeout_s: float,
    on_sent: Callable[[Departure], None] = lambda _: None,
) -> Report:
    """Send scans when they are due; a scan that is late is sent at once, none is left out.

    Args:
        departures: ordered by the time they are due.
        senders: one per robot.
        stop: ends the dispatch when set.
        timeout_s: how long to wait for a map service that goes away.
        on_sent: told of every scan.

    Raises:
        DeliveryError: the map service went away and did not come back within `timeout_s`.
    """
    sent = [0] * len(senders)
    most_late_s = 0.0
    started = time.monotonic()
    for departure in departures:
        early_s = departure.due_s - (time.monotonic() - started)
        if stop.is_set() or (early_s > 0.0 and stop.wait(early_s)):
            break
        if departure.due_s > 0.0:
            most_late_s = max(most_late_s, -early_s)
        sender = senders[departure.robot]
        if not sender.ready and not _await_return(sender, timeout_s, stop, sum(sent)):
            break
        sender.publish(departure.scan)
        sent[departure.robot] += 1
        on_sent(departure)
    # Every robot, even after one that fails.
    drained = [_drain(sender, stop, timeout_s) for sender in senders]
    return Report(
        sent=tuple(sent),
        elapsed_s=time.monotonic() - started,
        most_late_s=most_late_s,
        interruptions=sum(sender.interruptions for sender in senders if not sender.reliable),
        drained=all(drained),
        stopped=stop.is_set(),
    )


def _await_return(sender: Sender, timeout_s: float, stop: Event, sent: int) -> bool:
    try:
        return await_map([sender], timeout_s, stop)
    except DeliveryError as error:
        message = (
            f"the map service went away after {sent} scans and was not back within "
            f"{timeout_s:g} s: {error}"
        )
        raise DeliveryError(message) from error


def _drain(sender: Sender, stop: Event, timeout_s: float) -> bool:
    """Wait until all is through; a reliable sender may wait for a map that comes back."""
    patience_s = timeout_s if sender.reliable else 0.0
    end = seen = time.monotonic()
    end += DRAIN_TIMEOUT_S
    while not sender.drain(_DRAIN_POLL_S):
        now = time.monotonic()
        if sender.ready:
            seen = now
        if stop.is_set() or now > end or now - seen > patience_s:
            return False
    return True
