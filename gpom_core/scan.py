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
        ranges_m: (n,) float32, one per beam, as REP 117. What is masked becomes ``NaN``.
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
        check_fields(
            self.pose, self.boot, self.seq, self.stamp_ns, _as_float32(self), self.ranges_m.size
        )

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
    if isinstance(values, np.ma.MaskedArray):  # else numpy would take what is under the mask
        values = np.where(np.ma.getmaskarray(values), np.nan, values.data)
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


def _as_float32(scan: Scan) -> tuple[float, ...]:
    """The fields that travel as float32, as they arrive."""
    if len(scan.pose_covariance) != 6:
        message = f"the pose covariance has {len(scan.pose_covariance)} numbers; expected 6"
        raise InvalidScanError("bad_covariance", message)
    try:
        packed = _FLOAT32_FIELDS.pack(
            *scan.pose_covariance,
            scan.angle_min_rad,
            scan.angle_increment_rad,
            scan.time_increment_s,
            scan.range_min_m,
            scan.range_max_m,
            scan.scan_time_s,
        )
    except OverflowError as error:
        message = "an angle, range limit, time or covariance is too large for a 32-bit float"
        raise InvalidScanError("too_large", message) from error
    return _FLOAT32_FIELDS.unpack(packed)


def check_fields(
    pose: tuple[float, ...],
    boot: int,
    seq: int,
    stamp_ns: int,
    float32: tuple[float, ...],
    beams: int,
) -> None:
    """Check all of a scan but its arrays. Chained comparisons refuse NaN as well.

    Args:
        pose: x, y, yaw. float32: the six of the covariance, angle_min, angle_increment,
            time_increment, range_min, range_max, scan_time, as float32 holds them.

    Raises:
        InvalidScanError: a value is out of range; ``reason`` says which.
    """
    x, y, yaw = pose
    if not (
        -MAX_ABS_POSITION_M <= x <= MAX_ABS_POSITION_M
        and -MAX_ABS_POSITION_M <= y <= MAX_ABS_POSITION_M
        and -MAX_ABS_YAW_RAD <= yaw <= MAX_ABS_YAW_RAD
    ):
        raise _bad_pose(pose)
    if not (0 <= boot < _BOOT_END and 0 <= seq < _SEQ_END):
        message = f"boot {boot} and seq {seq} are implausible; expected below 2^63 - 1 and 2^48"
        raise InvalidScanError("bad_sequence", message)
    if not -_INT64_END <= stamp_ns < _INT64_END:
        message = f"stamp {stamp_ns} ns must be a signed 64-bit number"
        raise InvalidScanError("bad_stamp", message)
    _, _, _, _, _, _, first_rad, step_rad, time_increment, range_min, range_max, scan_time = float32
    last_rad = first_rad + step_rad * (beams - 1)
    if not (
        -MAX_ABS_ANGLE_RAD <= first_rad <= MAX_ABS_ANGLE_RAD
        and -MAX_ABS_ANGLE_RAD <= last_rad <= MAX_ABS_ANGLE_RAD
        and (step_rad != 0.0 or beams == 1)
    ):
        raise _bad_angles(first_rad, step_rad, beams)
    if not 0.0 <= range_min < range_max <= MAX_RANGE_M:
        message = (
            f"range limits {range_min:g} to {range_max:g} m; expected "
            f"0 <= range_min < range_max <= {MAX_RANGE_M:g} m"
        )
        raise InvalidScanError("bad_range_limits", message)
    if not (isfinite(time_increment) and isfinite(scan_time)):
        message = f"time increment and scan time {(time_increment, scan_time)} s must be finite"
        raise InvalidScanError("non_finite_time", message)
    if not isfinite(sum(float32[:6])):  # of float32, which cannot overflow
        message = f"the pose covariance {float32[:6]} must be finite; zeros mean unknown"
        raise InvalidScanError("bad_covariance", message)


def _bad_pose(pose: tuple[float, ...]) -> InvalidScanError:
    if not all(map(isfinite, pose)):
        message = f"the pose {tuple(pose)} is not finite; send the scan once its pose is known"
        return InvalidScanError("non_finite_pose", message)
    message = (
        f"the pose {tuple(pose)} is out of range; expected |x| and |y| up to "
        f"{MAX_ABS_POSITION_M:g} m and |yaw| up to {MAX_ABS_YAW_RAD:g} rad"
    )
    return InvalidScanError("pose_out_of_range", message)


def _bad_angles(first_rad: float, step_rad: float, beams: int) -> InvalidScanError:
    if not (isfinite(first_rad) and isfinite(step_rad)):
        message = f"angle_min {first_rad} and angle_increment {step_rad} must be finite"
        return InvalidScanError("non_finite_angle", message)
    if step_rad == 0.0 and beams > 1:
        message = f"angle_increment is zero, so all {beams} beams coincide; expected a step in rad"
        return InvalidScanError("zero_angle_increment", message)
    message = (
        f"beams go from {first_rad:g} to {first_rad + step_rad * (beams - 1):g} rad; expected both "
        f"within {MAX_ABS_ANGLE_RAD:g} rad of zero"
    )
    return InvalidScanError("angle_out_of_range", message)


def assemble(
    pose: Pose2D,
    ranges_m: NDArray[np.float32],
    intensities: NDArray[np.float32] | None,
    stream: tuple[int, int, int, bool],
    float32: tuple[float, ...],
) -> Scan:
    """A scan of values that `check_fields` passed and that have their types already.

    Args:
        ranges_m, intensities: (n,) read-only. stream: stamp, boot, seq, reliable.
        float32: as in `check_fields`.
    """
    scan = object.__new__(Scan)
    put = object.__setattr__  # as the dataclass does; it would then coerce and check again
    put(scan, "pose", pose)
    put(scan, "ranges_m", ranges_m)
    put(scan, "angle_min_rad", float32[6])
    put(scan, "angle_increment_rad", float32[7])
    put(scan, "range_min_m", float32[9])
    put(scan, "range_max_m", float32[10])
    put(scan, "stamp_ns", stream[0])
    put(scan, "boot", stream[1])
    put(scan, "seq", stream[2])
    put(scan, "reliable", stream[3])
    put(scan, "time_increment_s", float32[8])
    put(scan, "scan_time_s", float32[11])
    put(scan, "pose_covariance", float32[:6])
    put(scan, "intensities", intensities)
    return scan
