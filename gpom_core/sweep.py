"""A sweep as a sensor measured it, in its own frame, and how it becomes a scan of the map.

A native publisher knows where its sensor is and sends scans. Everyone else has a sweep here and a
pose there: this is where the two meet, and where the motion during a sweep is taken out.
"""

from dataclasses import dataclass, replace
from math import acos, pi
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from gpom_core.errors import InvalidScanError
from gpom_core.scan import Pose2D, Scan
from gpom_core.transforms import Rigid, distance_m, planar

TILT_MAX_RAD = 0.35
"""A sensor that leans more than this does not measure the floor plan."""

_NANOSECONDS = 1e9
_SWEEP_MAX_S = 2.0
_STILL_M = 1e-3
_STILL_RAD = 1e-4
# Neighbouring beams belong to one surface when their ranges differ by less than this share.
_SURFACE_SHARE = 0.1

Floats = NDArray[np.float64]


class Stream(NamedTuple):
    """Which scan of which stream it is; fields as in `Scan`."""

    boot: int = 0
    seq: int = 0


_UNKNOWN = (0.0,) * 6
_NO_STREAM = Stream()


@dataclass(frozen=True, slots=True, eq=False)
class Sweep:
    """One sweep of one sensor, in the frame of the sensor; fields as in `Scan`.

    Attributes:
        frame: of the sensor.
    """

    frame: str
    stamp_ns: int
    ranges_m: NDArray[np.float32]
    angle_min_rad: float
    angle_increment_rad: float
    range_min_m: float
    range_max_m: float
    time_increment_s: float = 0.0
    scan_time_s: float = 0.0
    intensities: NDArray[np.float32] | None = None

    @property
    def last_stamp_ns(self) -> int:
        """When the last beam was measured; that of the first when the sensor does not say."""
        duration_s = self.time_increment_s * (self.ranges_m.size - 1)
        if not 0.0 < duration_s <= _SWEEP_MAX_S:
            return self.stamp_ns
        return self.stamp_ns + round(duration_s * _NANOSECONDS)


def to_scan(
    sweep: Sweep,
    pose: Rigid,
    pose_covariance: tuple[float, ...] = _UNKNOWN,
    stream: Stream = _NO_STREAM,
) -> Scan:
    """Give the sweep as measured from one place.

    A sensor that hangs upside down turns the other way when seen from above.

    Args:
        sweep: as measured.
        pose: of the sensor in the map.
        pose_covariance: as in `Scan`.
        stream: likewise.

    Raises:
        InvalidScanError: the sensor is tilted (``tilted``), or the sweep makes no valid scan.
    """
    seen = planar(pose)
    tilt_rad = acos(min(abs(seen.up), 1.0))
    if tilt_rad > TILT_MAX_RAD:
        message = (
            f"the sensor {sweep.frame} leans by {tilt_rad * 180 / pi:.0f} degrees; expected a "
            f"level one, at most {TILT_MAX_RAD * 180 / pi:.0f}: is its transform right?"
        )
        raise InvalidScanError("tilted", message)
    turn = 1.0 if seen.up > 0.0 else -1.0
    return Scan(
        pose=Pose2D(seen.x_m, seen.y_m, seen.yaw_rad),
        ranges_m=sweep.ranges_m,
        angle_min_rad=turn * sweep.angle_min_rad,
        angle_increment_rad=turn * sweep.angle_increment_rad,
        range_min_m=sweep.range_min_m,
        range_max_m=sweep.range_max_m,
        stamp_ns=sweep.stamp_ns,
        boot=stream.boot,
        seq=stream.seq,
        time_increment_s=sweep.time_increment_s,
        scan_time_s=sweep.scan_time_s,
        pose_covariance=pose_covariance,
        intensities=sweep.intensities,
    )


def to_still_scan(
    sweep: Sweep,
    first: Rigid,
    last: Rigid,
    pose_covariance: tuple[float, ...] = _UNKNOWN,
    stream: Stream = _NO_STREAM,
) -> Scan:
    """Give the sweep as it would have been measured from where its first beam was.

    Every beam has its own pose, interpolated between those of the first and the last. Turning
    while sweeping spreads or narrows the beams, which a different angle between them says exactly.
    Driving shifts their ends; the ends are read again along evenly spaced directions, between two
    beams when both are of one surface.

    Args:
        sweep: as measured.
        first: pose of the sensor in the map at the first beam.
        last: the same at the last beam.
        pose_covariance: as in `Scan`.
        stream: likewise.

    Raises:
        InvalidScanError: as `to_scan`.
    """
    scan = to_scan(sweep, first, pose_covariance, stream)
    end = planar(last)
    turn_rad = (end.yaw_rad - scan.pose.yaw_rad + pi) % (2.0 * pi) - pi
    count = scan.ranges_m.size
    if count < 2 or (distance_m(first, last) < _STILL_M and abs(turn_rad) < _STILL_RAD):
        return scan
    increment_rad = scan.angle_increment_rad + turn_rad / (count - 1)
    # Same number of beams, in the same order: a turn faster than the sweep would undo that.
    if increment_rad * scan.angle_increment_rad <= 0.0:
        message = f"the sensor {sweep.frame} turned by {turn_rad:.2f} rad, faster than it sweeps"
        raise InvalidScanError("turned_too_fast", message)
    angles_rad: Floats = scan.angle_min_rad + increment_rad * np.arange(count, dtype=np.float64)
    cos, sin = np.cos(scan.pose.yaw_rad), np.sin(scan.pose.yaw_rad)
    dx_m, dy_m = end.x_m - scan.pose.x_m, end.y_m - scan.pose.y_m
    drive_m = np.array([cos * dx_m + sin * dy_m, -sin * dx_m + cos * dy_m])
    ranges_m = _shifted(scan, angles_rad, drive_m)
    return replace(
        scan,
        ranges_m=ranges_m.astype(np.float32),
        angle_increment_rad=increment_rad,
        time_increment_s=0.0,
    )


def _shifted(scan: Scan, angles_rad: Floats, drive_m: Floats) -> Floats:
    """Give the ranges from the first place, along the same directions."""
    ranges_m = scan.ranges_m.astype(np.float64)
    hits = scan.hits()
    way = np.linspace(0.0, 1.0, ranges_m.size)
    length_m = np.where(hits, ranges_m, 0.0)
    x_m = way * drive_m[0] + length_m * np.cos(angles_rad)
    y_m = way * drive_m[1] + length_m * np.sin(angles_rad)
    moved_m = np.where(hits, np.hypot(x_m, y_m), ranges_m)
    aside_rad = (np.arctan2(y_m, x_m) - angles_rad + pi) % (2.0 * pi) - pi
    step_rad = angles_rad[1] - angles_rad[0]
    place = np.arange(ranges_m.size, dtype=np.float64) + np.where(hits, aside_rad / step_rad, 0.0)
    return _read_at_whole_places(place, moved_m, hits)


def _read_at_whole_places(place: Floats, ranges_m: Floats, hits: NDArray[np.bool_]) -> Floats:
    """Read ranges given at uneven places at 0, 1, 2, …: on one surface between two beams.

    Where the two are not of one surface, the nearer one is read. Beams that cross (a near thing in
    front of a far one) are put in the order of their directions.
    """
    order = np.argsort(place, kind="stable")
    place, ranges_m, hits = place[order], ranges_m[order], hits[order]
    wanted = np.arange(place.size, dtype=np.float64)
    right = np.clip(np.searchsorted(place, wanted), 1, place.size - 1)
    left = right - 1
    gap = np.maximum(place[right] - place[left], 1e-12)
    share = np.clip((wanted - place[left]) / gap, 0.0, 1.0)
    low_m, high_m = ranges_m[left], ranges_m[right]
    nearest = np.where(share < 0.5, low_m, high_m)
    with np.errstate(invalid="ignore"):
        smooth = (
            hits[left]
            & hits[right]
            & (np.abs(high_m - low_m) < _SURFACE_SHARE * np.minimum(low_m, high_m))
        )
        return np.where(smooth, low_m + share * (high_m - low_m), nearest)
