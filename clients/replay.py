"""A recorded log as one robot, or cut into several that drive at the same time."""

from collections.abc import Sequence
from dataclasses import dataclass
from math import isfinite

import numpy as np

from clients.dispatch import Departure
from clients.logs import is_held_out
from gpom_core.errors import ConfigurationError
from gpom_core.scan import Scan

_NANOSECONDS = 1e9


@dataclass(frozen=True, slots=True)
class Pace:
    """When the scans of a robot are due; by default all at once, as fast as they are taken.

    Attributes:
        rate_hz: this many a second.
        speed: as recorded, so many times faster.

    Raises:
        ConfigurationError: both are given, or one is not positive.
    """

    rate_hz: float | None = None
    speed: float | None = None

    def __post_init__(self) -> None:
        if self.rate_hz is not None and self.speed is not None:
            message = "both a rate and a speed are given; expected one of them"
            raise ConfigurationError(message)
        for name in ("rate_hz", "speed"):
            value = getattr(self, name)
            if value is not None and not (isfinite(value) and value > 0.0):
                message = f"{name} is {value}; expected a positive number"
                raise ConfigurationError(message)

    def due_s(self, scans: Sequence[Scan]) -> list[float]:
        """Give the time of each scan after the first."""
        if self.rate_hz is not None:
            return [index / self.rate_hz for index in range(len(scans))]
        if self.speed is None:
            return [0.0] * len(scans)
        # Before floats, which cannot tell nanoseconds since the epoch apart.
        since_ns = [scan.stamp_ns - scans[0].stamp_ns for scan in scans]
        # A clock that was set back must not make the robot wait for its own past.
        seconds = np.maximum.accumulate(np.array(since_ns, dtype=np.float64)) / _NANOSECONDS
        return [float(value) for value in seconds / self.speed]


def cut(scans: Sequence[Scan], robots: int, *, skip_held_out: bool = False) -> list[list[Scan]]:
    """Cut a log into contiguous trajectories of nearly the same number of scans.

    Args:
        scans: of the whole log.
        robots: number of trajectories.
        skip_held_out: leave out the scans that the evaluation protocol holds out; they are counted
            in the whole log, before it is cut.

    Raises:
        ConfigurationError: fewer scans than robots.
    """
    kept = [scan for i, scan in enumerate(scans) if not (skip_held_out and is_held_out(i))]
    if not 1 <= robots <= len(kept):
        message = f"{len(kept)} scans cannot be cut for {robots} robots; each needs at least one"
        raise ConfigurationError(message)
    ends = [len(kept) * (index + 1) // robots for index in range(robots)]
    return [kept[start:end] for start, end in zip([0, *ends], ends, strict=False)]


def schedule(trajectories: Sequence[Sequence[Scan]], pace: Pace) -> list[Departure]:
    """Order the scans of all robots by when they are due; robots take turns when they tie."""
    turns = [
        (due_s, turn, robot)
        for robot, scans in enumerate(trajectories)
        for turn, due_s in enumerate(pace.due_s(scans))
    ]
    return [
        Departure(due_s, robot, trajectories[robot][turn]) for due_s, turn, robot in sorted(turns)
    ]


def robot_names(name: str, robots: int) -> list[str]:
    """Name the robots: `name` for one, `name-1`, `name-2`, … for several."""
    return [name] if robots == 1 else [f"{name}-{index}" for index in range(1, robots + 1)]
