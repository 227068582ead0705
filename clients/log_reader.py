"""What every reader of recorded logs offers, whatever the format of the file."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from enum import StrEnum
from math import isfinite
from typing import Protocol

from gpom_core.errors import ConfigurationError
from gpom_core.scan import Scan

HELD_OUT_MODULUS = 10
HELD_OUT_REMAINDER = 5


class NoReturns(StrEnum):
    """What a beam without an echo says about the space along it."""

    IGNORE = "ignore"
    """Nothing: the range becomes NaN. Indoors most are failures on glass or dark surfaces."""
    FREE = "free"
    """All of it is empty up to the range limit: the range becomes +inf."""


@dataclass(frozen=True, slots=True)
class ReadOptions:
    """How raw readings become the ranges of a scan.

    A reading at or above the sensor's ceiling is a no-return, and so is one beyond `range_cap_m`:
    the cap cuts the sensor's sight, it does not move the echo nearer.

    Attributes:
        no_returns: what a no-return becomes.
        range_cap_m: longest range to believe; None for all that the sensor gives.
        range_ceiling_m: readings from here on are no-returns; None to find it in the log.
        topic: of the scans, in a bag that has several.
        map_frame: in which scans are placed, in a bag; None to find it.

    Raises:
        ConfigurationError: a limit is not a positive number.
    """

    no_returns: NoReturns = NoReturns.IGNORE
    range_cap_m: float | None = None
    range_ceiling_m: float | None = None
    topic: str | None = None
    map_frame: str | None = None

    def __post_init__(self) -> None:
        for name in ("range_cap_m", "range_ceiling_m"):
            value = getattr(self, name)
            if value is not None and not (isfinite(value) and value > 0.0):
                message = f"{name} is {value}; expected a positive number of metres"
                raise ConfigurationError(message)


@dataclass(frozen=True, slots=True)
class LogSummary:
    """What is in a log.

    Attributes:
        format: of the file, for people.
        scans: that can be read.
        beams: most in one scan.
        duration_s: from the first scan to the last.
        bounds_m: xmin, ymin, xmax, ymax of the sensor's poses.
        range_ceiling_m: readings from here on are no-returns; None when the log shows no ceiling.
        no_return_share: of all beams.
        skipped: unreadable records, number per reason.
        notes: what was chosen where there was a choice, for people.
    """

    format: str
    scans: int
    beams: int
    duration_s: float
    bounds_m: tuple[float, float, float, float]
    range_ceiling_m: float | None
    no_return_share: float
    skipped: Mapping[str, int] = field(default_factory=dict)
    notes: tuple[str, ...] = ()


class LogReader(Protocol):
    """A log of scans of one sensor, in the order of recording."""

    def __iter__(self) -> Iterator[Scan]:
        """Give the scans in the order of recording; may be called again."""
        ...

    def __len__(self) -> int:
        """Give the number of scans."""
        ...

    def describe(self) -> LogSummary:
        """Say what is in the log."""
        ...


def is_held_out(index: int) -> bool:
    """Whether the evaluation protocol keeps scan `index`, from 0 in the whole log, off the map."""
    return index % HELD_OUT_MODULUS == HELD_OUT_REMAINDER
