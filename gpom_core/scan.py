"""One sweep of one laser scanner: the only kind of evidence that enters the map.

Ranges follow REP 117: a finite range within ``[range_min_m, range_max_m]`` is a hit, ``+inf``
means nothing within ``range_max_m``, ``NaN`` is invalid, ``-inf`` is too close, and a finite range
outside the limits says nothing.
"""

import operator
import struct
from dataclasses import dataclass
from math import isfinite
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from gpom_core.errors import InvalidScanError

MAX_ABS_POSITION_M = 1e7
"""Largest ``|x|``, ``|y|`` of a pose: a quarter of the Earth's girth, so UTM northings just fit."""
MAX_ABS_YAW_RAD = 1e6
"""Largest ``|yaw|``: unwrapped headings are welcome, bit noise is not."""
MAX_ABS_ANGLE_RAD = 1e3
"""Largest ``|angle|`` of a beam in the frame of the sensor, 159 turns."""
MAX_RANGE_M = 1e6
"""Largest ``range_max_m``."""

# Everything that travels as float32 is checked as float32, so whatever is a scan can be sent.
_FLOAT32_FIELDS = struct.Struct("<12f")
_BOOT_END = (1 << 63) - 1  # ns; far beyond any clock, with room for the run after it
_SEQ_END = 1 << 48  # a thousand scans a second for nine thousand years, and exact in JSON
_INT64_END = 1 << 63


class Pose2D(NamedTuple):
    """Pose of the sensor in the map frame."""

    x_m: float
    y_m: float
    yaw_rad: float


@dataclass(frozen=True, slots=True, eq=False)
class Scan:
    """A scan with the pose of its sensor. Immutable; its arrays are read-only.

    Attributes:
        pose: sensor in the map frame.
        ranges_m: (n,) float32, one per beam, as REP 117.
        angle_min_rad: direction of the first beam in the frame of the sensor.
        angle_increment_rad: from beam to beam; negative for a scanner mounted upside down.
        range_min_m: nearest range that counts as a hit.
        range_max_m: farthest range that counts as a hit; how far a ``+inf`` beam is empty.
        stamp_ns: time of the first beam, since the epoch.
        boot: start of the stream, ns; tells one run of a publisher from the next.
        seq: number of the scan in its stream, from 1; 0 when it belongs to none.
        reliable: whether the publisher repeats the scan until it is acknowledged.
        time_increment_s: from beam to beam.
        scan_time_s: from scan to scan.
        pose_covariance: xx xy xa yy ya aa in m and rad; zeros when unknown.
        intensities: (n,) float32, or None.

    Raises:
        InvalidScanError: a value is malformed or out of range; ``reason`` says which.
    """

    pose: Pose2D
    ranges_m: NDArray[np.float32]
    angle_min_rad: float
    angle_increment_rad: float
    range_min_m: float
    range_max_m: float
    stamp_ns: int = 0
    boot: int = 0
    seq: int = 0
    reliable: bool = False
    time_increment_s: float = 0.0
    scan_time_s: float = 0.0
    pose_covariance: tuple[float, ...] = (0.0,) * 6
    intensities: NDArray[np.float32] | None = None

    def __post_init__(self) -> None:
        """Bring every field to its type, then check it."""
        _coerce(self)
        _check_arrays(self)
        _check_pose(self.pose)
        _check_counters(self)
        _check_float32_fields(self)

    def beam_angles_rad(self) -> NDArray[np.float64]:
        """Directions of the beams in the map frame, (n,), not wrapped."""
        first = self.pose.yaw_rad + self.angle_min_rad
        return first + self.angle_increment_rad * np.arange(self.ranges_m.size, dtype=np.float64)

    def hits(self) -> NDArray[np.bool_]:
        """Mask (n,) of the beams that returned from within the limits of the scanner."""
        # Python floats are compared as float32, just as the limits travel: NaN and inf drop out.
        return (self.ranges_m >= self.range_min_m) & (self.ranges_m <= self.range_max_m)

    def no_returns(self) -> NDArray[np.bool_]:
        """Mask (n,) of the beams that met nothing within ``range_max_m``."""
        return np.isposinf(self.ranges_m)


def _coerce(scan: Scan) -> None:
    put = object.__setattr__  # the dataclass is frozen
    try:
        put(scan, "pose", Pose2D(*map(float, scan.pose)))
        for name in (
            "angle_min_rad",
            "angle_increment_rad",
            "range_min_m",
            "range_max_m",
            "time_increment_s",
            "scan_time_s",
        ):
            put(scan, name, float(getattr(scan, name)))
        for name in ("stamp_ns", "boot", "seq"):
            put(scan, name, operator.index(getattr(scan, name)))
        put(scan, "reliable", bool(scan.reliable))
        put(scan, "pose_covariance", tuple(map(float, scan.pose_covariance)))
        put(scan, "ranges_m", _read_only_float32(scan.ranges_m))
        if scan.intensities is not None:
            put(scan, "intensities", _read_only_float32(scan.intensities))
    except (TypeError, ValueError, OverflowError) as error:
        message = f"a field of the scan has the wrong type or shape: {error}"
        raise InvalidScanError("bad_field", message) from error


def _read_only_float32(values: ArrayLike) -> NDArray[np.float32]:
    source = np.asarray(values)
    flags = source.flags
    if source.dtype == np.float32 and flags.c_contiguous and flags.aligned and not flags.writeable:
        return source
    with np.errstate(over="ignore"):
        result = source.astype(np.float32, order="C")
    if source.dtype == np.float64:
        # Too large for float32 is not "nothing there", which is what inf would say.
        result[np.isinf(result) & np.isfinite(source)] = np.nan
    result.flags.writeable = False
    return result


def _check_arrays(scan: Scan) -> None:
    if scan.ranges_m.ndim != 1:
        message = f"ranges have shape {scan.ranges_m.shape}; expected (n,), one per beam"
        raise InvalidScanError("bad_shape", message)
    if scan.ranges_m.size == 0:
        raise InvalidScanError("no_beams", "the scan has no beams; expected at least one")
    if scan.intensities is not None and scan.intensities.shape != scan.ranges_m.shape:
        message = (
            f"intensities have shape {scan.intensities.shape}; expected "
            f"{scan.ranges_m.shape}, one per beam, or none at all"
        )
        raise InvalidScanError("bad_intensity_count", message)


def _check_pose(pose: Pose2D) -> None:
    if not all(map(isfinite, pose)):
        message = f"the pose {tuple(pose)} is not finite; send the scan once its pose is known"
        raise InvalidScanError("non_finite_pose", message)
    if (
        max(abs(pose.x_m), abs(pose.y_m)) > MAX_ABS_POSITION_M
        or abs(pose.yaw_rad) > MAX_ABS_YAW_RAD
    ):
        message = (
            f"the pose {tuple(pose)} is out of range; expected |x| and |y| up to "
            f"{MAX_ABS_POSITION_M:g} m and |yaw| up to {MAX_ABS_YAW_RAD:g} rad"
        )
        raise InvalidScanError("pose_out_of_range", message)


def _check_counters(scan: Scan) -> None:
    if not (0 <= scan.boot < _BOOT_END and 0 <= scan.seq < _SEQ_END):
        message = (
            f"boot {scan.boot} and seq {scan.seq} are implausible; expected below 2^63 - 1 and 2^48"
        )
        raise InvalidScanError("bad_sequence", message)
    if not -_INT64_END <= scan.stamp_ns < _INT64_END:
        message = f"stamp {scan.stamp_ns} ns must be a signed 64-bit number"
        raise InvalidScanError("bad_stamp", message)


def _check_float32_fields(scan: Scan) -> None:
    if len(scan.pose_covariance) != 6:
        message = f"the pose covariance has {len(scan.pose_covariance)} numbers; expected 6"
        raise InvalidScanError("bad_covariance", message)
    try:
        packed = _FLOAT32_FIELDS.pack(
            scan.angle_min_rad,
            scan.angle_increment_rad,
            scan.range_min_m,
            scan.range_max_m,
            scan.time_increment_s,
            scan.scan_time_s,
            *scan.pose_covariance,
        )
    except OverflowError as error:
        message = "an angle, range limit, time or covariance is too large for a 32-bit float"
        raise InvalidScanError("too_large", message) from error
    angle_min, increment, range_min, range_max, *others = _FLOAT32_FIELDS.unpack(packed)
    _check_angles(angle_min, increment, scan.ranges_m.size)
    _check_range_limits(range_min, range_max)
    if not all(map(isfinite, others[:2])):
        message = f"time increment and scan time {tuple(others[:2])} s must be finite"
        raise InvalidScanError("non_finite_time", message)
    if not all(map(isfinite, others[2:])):
        message = f"the pose covariance {tuple(others[2:])} must be finite; zeros mean unknown"
        raise InvalidScanError("bad_covariance", message)


def _check_angles(angle_min_rad: float, angle_increment_rad: float, beams: int) -> None:
    if not (isfinite(angle_min_rad) and isfinite(angle_increment_rad)):
        message = (
            f"angle_min {angle_min_rad} and angle_increment {angle_increment_rad} must be finite"
        )
        raise InvalidScanError("non_finite_angle", message)
    if angle_increment_rad == 0.0 and beams > 1:
        message = f"angle_increment is zero, so all {beams} beams coincide; expected a step in rad"
        raise InvalidScanError("zero_angle_increment", message)
    last_rad = angle_min_rad + angle_increment_rad * (beams - 1)
    if max(abs(angle_min_rad), abs(last_rad)) > MAX_ABS_ANGLE_RAD:
        message = (
            f"beams go from {angle_min_rad:g} to {last_rad:g} rad; expected both within "
            f"{MAX_ABS_ANGLE_RAD:g} rad of zero"
        )
        raise InvalidScanError("angle_out_of_range", message)


def _check_range_limits(range_min_m: float, range_max_m: float) -> None:
    if not 0.0 <= range_min_m < range_max_m <= MAX_RANGE_M:
        message = (
            f"range limits {range_min_m:g} to {range_max_m:g} m; expected "
            f"0 <= range_min < range_max <= {MAX_RANGE_M:g} m"
        )
        raise InvalidScanError("bad_range_limits", message)
