"""Rigid motions in space: what relates one coordinate frame to another.

Plain floats, not arrays: a chain of three or four takes microseconds, and every scan needs one.
"""

from math import atan2, cos, hypot, isfinite, sin, sqrt
from typing import NamedTuple

from gpom_core.errors import InvalidTransformError

_UNIT_TOLERANCE = 0.1
"""How far the length of a quaternion may be from 1: what travels as float32, or was typed by hand,
is a little off; what is far off is no rotation."""
_NEARLY_PARALLEL = 0.9995
"""From this cosine on, a straight line between unit quaternions is as good as the arc."""


class Rigid(NamedTuple):
    """Pose of a frame in another one: a point moves from the first to the second by it.

    The rotation is a unit quaternion.
    """

    x_m: float
    y_m: float
    z_m: float
    qx: float
    qy: float
    qz: float
    qw: float


IDENTITY = Rigid(0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0)


class Planar(NamedTuple):
    """What of a pose matters to a map of the floor.

    Attributes:
        x_m: of the origin.
        y_m: of the origin.
        yaw_rad: direction of the frame's x axis, seen from above.
        up: how upright the frame is: cosine between its z axis and the vertical, -1 upside down.
    """

    x_m: float
    y_m: float
    yaw_rad: float
    up: float


def rigid(x_m: float, y_m: float, z_m: float, qx: float, qy: float, qz: float, qw: float) -> Rigid:
    """Give the motion with these numbers, its quaternion brought to length 1.

    Raises:
        InvalidTransformError: a number is not finite, or the quaternion is no rotation.
    """
    numbers = (x_m, y_m, z_m, qx, qy, qz, qw)
    if not all(map(isfinite, numbers)):
        raise InvalidTransformError(f"the transform {numbers} is not finite")
    length = sqrt(qx * qx + qy * qy + qz * qz + qw * qw)
    if abs(length - 1.0) > _UNIT_TOLERANCE:
        message = f"the quaternion {numbers[3:]} has length {length:.3g}; expected 1"
        raise InvalidTransformError(message)
    return Rigid(x_m, y_m, z_m, qx / length, qy / length, qz / length, qw / length)


def from_planar(x_m: float, y_m: float, yaw_rad: float) -> Rigid:
    """Give the motion of a robot on the floor."""
    return Rigid(x_m, y_m, 0.0, 0.0, 0.0, sin(yaw_rad / 2.0), cos(yaw_rad / 2.0))


def rotate(pose: Rigid, x: float, y: float, z: float) -> tuple[float, float, float]:
    """Turn a vector by the rotation of a pose."""
    _, _, _, qx, qy, qz, qw = pose
    # v + 2 q x (q x v + w v)
    tx = qy * z - qz * y + qw * x
    ty = qz * x - qx * z + qw * y
    tz = qx * y - qy * x + qw * z
    return (
        x + 2.0 * (qy * tz - qz * ty),
        y + 2.0 * (qz * tx - qx * tz),
        z + 2.0 * (qx * ty - qy * tx),
    )


def compose(first: Rigid, second: Rigid) -> Rigid:
    """Chain two motions: `first` is b in a, `second` is c in b, the result is c in a."""
    x, y, z = rotate(first, *second[:3])
    ax, ay, az, aw = first[3:]
    bx, by, bz, bw = second[3:]
    return Rigid(
        first.x_m + x,
        first.y_m + y,
        first.z_m + z,
        aw * bx + ax * bw + ay * bz - az * by,
        aw * by - ax * bz + ay * bw + az * bx,
        aw * bz + ax * by - ay * bx + az * bw,
        aw * bw - ax * bx - ay * by - az * bz,
    )


def inverse(pose: Rigid) -> Rigid:
    """Turn b in a into a in b."""
    back = Rigid(0.0, 0.0, 0.0, -pose.qx, -pose.qy, -pose.qz, pose.qw)
    x, y, z = rotate(back, *pose[:3])
    return back._replace(x_m=-x, y_m=-y, z_m=-z)


def interpolate(first: Rigid, second: Rigid, fraction: float) -> Rigid:
    """Go a fraction of the way, straight for the place and along the shorter arc for the turn.

    Source: K. Shoemake, "Animating rotation with quaternion curves" (1985).
    """
    cosine = sum(a * b for a, b in zip(first[3:], second[3:], strict=True))
    # q and -q are one rotation; the nearer of the two gives the shorter way.
    sign = -1.0 if cosine < 0.0 else 1.0
    cosine = abs(cosine)
    near, far = 1.0 - fraction, fraction
    if cosine < _NEARLY_PARALLEL:
        angle = atan2(sqrt(1.0 - cosine * cosine), cosine)
        near, far = sin(near * angle) / sin(angle), sin(far * angle) / sin(angle)
    turned = [near * a + sign * far * b for a, b in zip(first[3:], second[3:], strict=True)]
    length = sqrt(sum(value * value for value in turned))
    place = [a + fraction * (b - a) for a, b in zip(first[:3], second[:3], strict=True)]
    return Rigid(*place, *(value / length for value in turned))


def planar(pose: Rigid) -> Planar:
    """Look at a pose from above."""
    _, _, _, qx, qy, qz, qw = pose
    ahead_x = 1.0 - 2.0 * (qy * qy + qz * qz)
    ahead_y = 2.0 * (qx * qy + qw * qz)
    up = 1.0 - 2.0 * (qx * qx + qy * qy)
    return Planar(pose.x_m, pose.y_m, atan2(ahead_y, ahead_x), up)


def distance_m(first: Rigid, second: Rigid) -> float:
    """Give the way between two places on the floor."""
    return hypot(second.x_m - first.x_m, second.y_m - first.y_m)
