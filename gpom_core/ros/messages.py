"""Laser scans, transforms and poses out of ROS messages, occupancy grids into them.

Messages are taken as objects, so those of ROS 1 bags serve as well; ``read_…`` take CDR bytes.
"""

from collections.abc import Iterator
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from gpom_core.errors import InvalidTransformError, RosMessageError
from gpom_core.ros import cdr
from gpom_core.scan import Scan
from gpom_core.sweep import Sweep
from gpom_core.transforms import Rigid, rigid

_NANOSECONDS = 1_000_000_000
# Of the 6 x 6 matrix over x y z roll pitch yaw: xx xy xa yy ya aa.
_PLANAR_COVARIANCE = (0, 1, 5, 7, 11, 35)

Cells = NDArray[np.int8]


class StampedTransform(NamedTuple):
    """A frame in its parent at a moment."""

    parent: str
    child: str
    stamp_ns: int
    pose: Rigid


class StampedPose(NamedTuple):
    """A robot in a fixed frame at a moment.

    Attributes:
        frame: the pose is given in.
        child: frame whose pose it is; empty when the message does not say.
        stamp_ns: of the moment.
        pose: of the child in the frame.
        covariance: xx xy xa yy ya aa; zeros when unknown.
    """

    frame: str
    child: str
    stamp_ns: int
    pose: Rigid
    covariance: tuple[float, ...]


def read_sweep(payload: bytes, beams_max: int) -> Sweep:
    """Read a ``sensor_msgs/LaserScan``.

    Raises:
        RosMessageError: ``bad_cdr`` and what else `cdr.decode` finds, ``too_many_beams``.
    """
    sweep = sweep_of(cdr.decode(payload, cdr.LASER_SCAN))
    if sweep.ranges_m.size > beams_max:
        message = f"{sweep.ranges_m.size} beams; at most {beams_max} are allowed here"
        raise RosMessageError("too_many_beams", message)
    return sweep


def read_transforms(payload: bytes) -> Iterator[StampedTransform]:
    """Read a ``tf2_msgs/TFMessage``.

    Raises:
        RosMessageError: what `cdr.decode` finds.
        InvalidTransformError: one of them is no transform.
    """
    return transforms_of(cdr.decode(payload, cdr.TF_MESSAGE))


def sweep_of(message: Any) -> Sweep:
    """Take what counts from a ``sensor_msgs/LaserScan``."""
    ranges_m, intensities = message.ranges, message.intensities
    return Sweep(
        frame=frame_name(message.header.frame_id),
        stamp_ns=stamp_ns(message.header.stamp),
        ranges_m=ranges_m,
        angle_min_rad=message.angle_min,
        angle_increment_rad=message.angle_increment,
        range_min_m=message.range_min,
        range_max_m=message.range_max,
        time_increment_s=message.time_increment,
        scan_time_s=message.scan_time,
        # Some drivers send one intensity for all, or none.
        intensities=intensities if intensities.size == ranges_m.size else None,
    )


def transforms_of(message: Any) -> Iterator[StampedTransform]:
    """Take the transforms from a ``tf2_msgs/TFMessage``.

    Raises:
        InvalidTransformError: one of them is no transform; only after all that are good.
    """
    bad: InvalidTransformError | None = None
    for item in message.transforms:
        try:
            transform = _transform(item)
        except InvalidTransformError as error:  # a joint without a reading must not take all along
            bad = bad or error
        else:
            yield transform
    if bad is not None:
        raise bad


def _transform(item: Any) -> StampedTransform:
    parent, child = frame_name(item.header.frame_id), frame_name(item.child_frame_id)
    if not parent or not child or parent == child:
        raise InvalidTransformError(f"the transform from {parent!r} to {child!r} relates no frames")
    try:
        pose = _rigid(item.transform.translation, item.transform.rotation)
    except InvalidTransformError as error:
        raise InvalidTransformError(f"from {parent} to {child}: {error}") from error
    return StampedTransform(parent, child, stamp_ns(item.header.stamp), pose)


def pose_of(message: Any) -> StampedPose:
    """Take the pose from a ``nav_msgs/Odometry`` or ``geometry_msgs/PoseWithCovarianceStamped``.

    Raises:
        InvalidTransformError: it is no pose.
    """
    covariance = message.pose.covariance
    return StampedPose(
        frame_name(message.header.frame_id),
        frame_name(getattr(message, "child_frame_id", "")),
        stamp_ns(message.header.stamp),
        _rigid(message.pose.pose.position, message.pose.pose.orientation),
        tuple(float(covariance[index]) for index in _PLANAR_COVARIANCE),
    )


def write_grid(
    cells: Cells, origin: tuple[float, float], resolution_m: float, frame: str, at_ns: int
) -> bytes:
    """Write a ``nav_msgs/OccupancyGrid``.

    Args:
        cells: (rows, columns), row 0 at ymin: 0 to 100 per cent, -1 unknown.
        origin: x and y of the lower left corner of the first cell, in m.
        resolution_m: edge of a cell.
        frame: of the map.
        at_ns: time of the map.
    """
    rows, columns = cells.shape
    pose = cdr.make(
        "geometry_msgs/msg/Pose",
        position=cdr.make("geometry_msgs/msg/Point", x=origin[0], y=origin[1], z=0.0),
        orientation=cdr.make("geometry_msgs/msg/Quaternion", x=0.0, y=0.0, z=0.0, w=1.0),
    )
    info = cdr.make(
        "nav_msgs/msg/MapMetaData",
        map_load_time=_time(at_ns),
        resolution=resolution_m,
        width=columns,
        height=rows,
        origin=pose,
    )
    message = cdr.make(
        cdr.OCCUPANCY_GRID, header=_header(frame, at_ns), info=info, data=cells.ravel()
    )
    return cdr.encode(message, cdr.OCCUPANCY_GRID)


def write_grid_update(cells: Cells, column: int, row: int, frame: str, at_ns: int) -> bytes:
    """Write a ``map_msgs/OccupancyGridUpdate``: cells of a part of the last grid.

    Args:
        cells: (rows, columns) as of the grid.
        column: of the grid, where the part begins.
        row: likewise.
        frame: of the map.
        at_ns: time of the map.
    """
    rows, columns = cells.shape
    message = cdr.make(
        cdr.GRID_UPDATE,
        header=_header(frame, at_ns),
        x=column,
        y=row,
        width=columns,
        height=rows,
        data=cells.ravel(),
    )
    return cdr.encode(message, cdr.GRID_UPDATE)


def write_laser_scan(scan: Scan, frame: str) -> bytes:
    """Write a scan as ``sensor_msgs/LaserScan``; its pose goes by `write_transform`."""
    last = scan.angle_min_rad + scan.angle_increment_rad * (scan.ranges_m.size - 1)
    none = np.zeros(0, np.float32)
    message = cdr.make(
        cdr.LASER_SCAN,
        header=_header(frame, scan.stamp_ns),
        angle_min=scan.angle_min_rad,
        angle_max=last,
        angle_increment=scan.angle_increment_rad,
        time_increment=scan.time_increment_s,
        scan_time=scan.scan_time_s,
        range_min=scan.range_min_m,
        range_max=scan.range_max_m,
        ranges=scan.ranges_m,
        intensities=none if scan.intensities is None else scan.intensities,
    )
    return cdr.encode(message, cdr.LASER_SCAN)


def write_transform(parent: str, child: str, pose: Rigid, at_ns: int) -> bytes:
    """Write a ``tf2_msgs/TFMessage`` with one transform."""
    transform = cdr.make(
        "geometry_msgs/msg/Transform",
        translation=cdr.make("geometry_msgs/msg/Vector3", x=pose.x_m, y=pose.y_m, z=pose.z_m),
        rotation=cdr.make(
            "geometry_msgs/msg/Quaternion", x=pose.qx, y=pose.qy, z=pose.qz, w=pose.qw
        ),
    )
    item = cdr.make(
        "geometry_msgs/msg/TransformStamped",
        header=_header(parent, at_ns),
        child_frame_id=child,
        transform=transform,
    )
    return cdr.encode(cdr.make(cdr.TF_MESSAGE, transforms=[item]), cdr.TF_MESSAGE)


def stamp_ns(stamp: Any) -> int:
    """Give a ROS time in ns."""
    return int(stamp.sec) * _NANOSECONDS + int(stamp.nanosec)


def frame_name(name: str) -> str:
    """Give the name of a frame as ROS 2 writes it: without the slash that ROS 1 began with."""
    return name.lstrip("/")


def _rigid(place: Any, turn: Any) -> Rigid:
    return rigid(place.x, place.y, place.z, turn.x, turn.y, turn.z, turn.w)


def _time(at_ns: int) -> Any:
    seconds, nanoseconds = divmod(at_ns, _NANOSECONDS)
    return cdr.make("builtin_interfaces/msg/Time", sec=seconds, nanosec=nanoseconds)


def _header(frame: str, at_ns: int) -> Any:
    return cdr.make("std_msgs/msg/Header", stamp=_time(at_ns), frame_id=frame)
