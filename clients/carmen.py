"""Logs of the CARMEN robot toolkit: text, one message a line, often gzipped.

Read are the lines ``FLASER n r_1 … r_n x y theta odom_x odom_y odom_theta ipc_time host
logger_time``. The scanner sees 180 degrees from -90; the first pose is that of the laser, which in
a corrected log is the result of SLAM. Other messages (ODOM, PARAM, …) are passed over.
"""

import gzip
import zlib
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass
from math import isfinite, pi
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from clients.errors import LogReadError
from clients.log_reader import LogSummary, NoReturns, ReadOptions
from gpom_core.errors import InvalidScanError
from gpom_core.scan import Pose2D, Scan

RANGE_MIN_M = 0.01
"""A reading of zero is a failed one."""
SICK_CEILING_M = 81.0
"""A SICK scanner at its 80 m setting reports errors as 81 to 81.91 m."""
SICK_LARGEST_M = 81.92

_GZIP_MAGIC = b"\x1f\x8b"
_TAIL = 9  # two poses, ipc_time, host, logger_time
_NANOSECONDS = 1e9
_MOST_BEAMS = 100_000
# A ceiling is a spike: the largest reading comes this often, and so many times as often as any of
# the readings next to it.
_SPIKE_COUNT = 10
_SPIKE_RATIO = 5
_SPIKE_NEIGHBOURS = 10


@dataclass(frozen=True, slots=True)
class _Record:
    """One readable FLASER line."""

    readings_m: NDArray[np.float64]
    pose: Pose2D
    stamp_ns: int


class _BadLineError(Exception):
    """A FLASER line that cannot be read; the argument is the reason, for counting."""


class CarmenLog:
    """The scans of a CARMEN log, read as a whole when the object is made.

    Lines that cannot be read are skipped and counted per reason in `describe().skipped`.

    Args:
        path: of a text file, gzipped or not (told by its content).
        options: what becomes of no-returns and long ranges.

    Raises:
        LogReadError: the file is missing, damaged, or has no readable FLASER line.
    """

    def __init__(self, path: Path, options: ReadOptions | None = None) -> None:
        options = options or ReadOptions()
        records, self._skipped, others = _read_records(Path(path))
        self._ceiling_m = options.range_ceiling_m
        if self._ceiling_m is None and records:
            self._ceiling_m = find_ceiling(np.concatenate([r.readings_m for r in records]))
        self.scans = _to_scans(records, options, self._ceiling_m, self._skipped)
        if not self.scans:
            raise LogReadError(_nothing_to_read(path, self._skipped, others))
        self._no_returns = sum(_count_no_returns(r, self._ceiling_m) for r in records)

    def __iter__(self) -> Iterator[Scan]:
        return iter(self.scans)

    def __len__(self) -> int:
        return len(self.scans)

    def describe(self) -> LogSummary:
        """Say what is in the log."""
        poses = np.array([scan.pose[:2] for scan in self.scans])
        low, high = poses.min(axis=0), poses.max(axis=0)
        stamps_ns = [scan.stamp_ns for scan in self.scans]
        sizes = [scan.ranges_m.size for scan in self.scans]
        return LogSummary(
            format="CARMEN log",
            scans=len(self.scans),
            beams=max(sizes),
            duration_s=(max(stamps_ns) - min(stamps_ns)) / _NANOSECONDS,
            bounds_m=(float(low[0]), float(low[1]), float(high[0]), float(high[1])),
            range_ceiling_m=self._ceiling_m,
            no_return_share=self._no_returns / sum(sizes),
            skipped=dict(self._skipped),
        )


def find_ceiling(readings_m: NDArray[np.float64]) -> float | None:
    """Find the reading from which on a log's readings are no-returns.

    That is 81 m for a SICK scanner, else the largest reading when it comes suspiciously often.

    Args:
        readings_m: (n,) all readings of the log.

    Returns:
        The ceiling in m, or None when the log shows none.
    """
    values, counts = np.unique(readings_m[np.isfinite(readings_m)], return_counts=True)
    if values.size == 0:
        return None
    largest = float(values[-1])
    if SICK_CEILING_M <= largest < SICK_LARGEST_M:
        return SICK_CEILING_M
    neighbours = counts[-1 - _SPIKE_NEIGHBOURS : -1]
    busiest = int(neighbours.max()) if neighbours.size else 0
    is_spike = counts[-1] >= _SPIKE_COUNT and counts[-1] >= _SPIKE_RATIO * busiest
    return largest if is_spike else None


def _read_records(path: Path) -> tuple[list[_Record], Counter[str], Counter[str]]:
    """Read all FLASER lines; give them, unreadable ones per reason, and other messages per name."""
    records: list[_Record] = []
    skipped: Counter[str] = Counter()
    others: Counter[str] = Counter()
    try:
        with path.open("rb") as raw:
            zipped = raw.read(len(_GZIP_MAGIC)) == _GZIP_MAGIC
        with gzip.open(path) if zipped else path.open("rb") as lines:
            for line in lines:
                name, _, rest = line.partition(b" ")
                if name.rstrip() != b"FLASER":
                    others[name[:20].decode("ascii", "replace").strip()] += 1
                    continue
                try:
                    records.append(_parse(rest.split()))
                except _BadLineError as error:
                    skipped[str(error)] += 1
    except (EOFError, gzip.BadGzipFile, zlib.error) as error:
        message = (
            f"{path} is damaged: {error} after {len(records)} scans; expected a whole gzip file. "
            "Fetch it again."
        )
        raise LogReadError(message) from error
    except OSError as error:
        message = f"cannot read {path}: {error.strerror or error}"
        raise LogReadError(message) from error
    return records, skipped, others


def _parse(tokens: list[bytes]) -> _Record:
    try:
        beams = int(tokens[0])
    except (IndexError, ValueError):
        raise _BadLineError("no number of beams") from None
    if not 2 <= beams <= _MOST_BEAMS:
        raise _BadLineError("impossible number of beams")
    if len(tokens) != 1 + beams + _TAIL:
        raise _BadLineError("truncated" if len(tokens) < 1 + beams + _TAIL else "too many fields")
    try:
        readings_m = np.array(tokens[1 : 1 + beams], dtype=np.float64)
        x_m, y_m, yaw_rad = map(float, tokens[1 + beams : 4 + beams])
        ipc_time_s, logger_time_s = float(tokens[-3]), float(tokens[-1])
    except ValueError:
        raise _BadLineError("not a number") from None
    if not all(map(isfinite, (x_m, y_m, yaw_rad))):
        raise _BadLineError("pose is not finite")
    # Some loggers leave ipc_time at zero.
    stamp_s = ipc_time_s if ipc_time_s > 0.0 else logger_time_s
    if not isfinite(stamp_s):
        raise _BadLineError("time is not finite")
    return _Record(readings_m, Pose2D(x_m, y_m, yaw_rad), round(stamp_s * _NANOSECONDS))


def _to_scans(
    records: list[_Record], options: ReadOptions, ceiling_m: float | None, skipped: Counter[str]
) -> list[Scan]:
    sight_m = min(options.range_cap_m or np.inf, ceiling_m or np.inf)
    if not isfinite(sight_m):
        sight_m = max(map(_longest_m, records), default=1.0)
    no_return = np.inf if options.no_returns is NoReturns.FREE else np.nan
    scans = []
    for record in records:
        ranges_m = record.readings_m.copy()
        ranges_m[ranges_m > sight_m] = no_return
        if ceiling_m is not None:
            ranges_m[record.readings_m >= ceiling_m] = no_return
        try:
            scans.append(_to_scan(record, ranges_m, sight_m))
        except InvalidScanError as error:
            skipped[error.reason] += 1
    return scans


def _to_scan(record: _Record, ranges_m: NDArray[np.float64], range_max_m: float) -> Scan:
    beams = ranges_m.size
    return Scan(
        pose=record.pose,
        ranges_m=ranges_m.astype(np.float32),
        angle_min_rad=-pi / 2,
        # 180 and 360 beams leave out the last direction, 181 and 361 have it.
        angle_increment_rad=pi / (beams - beams % 2),
        range_min_m=RANGE_MIN_M,
        range_max_m=range_max_m,
        stamp_ns=record.stamp_ns,
    )


def _longest_m(record: _Record) -> float:
    finite_m = record.readings_m[np.isfinite(record.readings_m)]
    return float(np.max(finite_m, initial=1.0))


def _count_no_returns(record: _Record, ceiling_m: float | None) -> int:
    return 0 if ceiling_m is None else int(np.count_nonzero(record.readings_m >= ceiling_m))


def _nothing_to_read(path: Path, skipped: Counter[str], others: Counter[str]) -> str:
    if skipped:
        reasons = ", ".join(f"{count} {reason}" for reason, count in skipped.most_common(5))
        return f"none of the FLASER lines of {path} can be read ({reasons})"
    start = f"{path} has no FLASER lines; expected a CARMEN log (.log or .log.gz) or a ROS bag"
    if not all(name.isprintable() and "\ufffd" not in name for name in others):
        return f"{start}, and this is no text at all"
    found = ", ".join(f"{count} {name!r}" for name, count in others.most_common(5))
    return f"{start}. Its lines begin with: {found or 'nothing, it is empty'}"
