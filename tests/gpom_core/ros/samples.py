"""ROS messages as bytes, made by rosbags alone: what a robot would send."""

from math import cos, sin

import numpy as np
from rosbags.typesys import Stores, get_typestore

STORE = get_typestore(Stores.ROS2_HUMBLE)
S = 1_000_000_000


def make(name, **fields):
    return STORE.types[name](**fields)


def time(stamp_ns):
    return make("builtin_interfaces/msg/Time", sec=stamp_ns // S, nanosec=stamp_ns % S)


def header(frame, stamp_ns):
    return make("std_msgs/msg/Header", stamp=time(stamp_ns), frame_id=frame)


def vector(x=0.0, y=0.0, z=0.0, kind="Vector3"):
    return make(f"geometry_msgs/msg/{kind}", x=float(x), y=float(y), z=float(z))


def turn(yaw=0.0):
    return make("geometry_msgs/msg/Quaternion", x=0.0, y=0.0, z=sin(yaw / 2), w=cos(yaw / 2))


def laser_scan(stamp_ns=0, frame="laser", ranges=(1.0, 2.0, 3.0), **fields):
    values = {
        "angle_min": -1.0,
        "angle_max": 1.0,
        "angle_increment": 0.5,
        "time_increment": 0.0,
        "scan_time": 0.1,
        "range_min": 0.1,
        "range_max": 30.0,
        "intensities": np.zeros(0, np.float32),
    } | fields
    return make(
        "sensor_msgs/msg/LaserScan",
        header=header(frame, stamp_ns),
        ranges=np.array(ranges, np.float32),
        **values,
    )


def tf(*transforms):
    """Each is parent, child, (x, y, yaw), stamp in ns."""
    items = [
        make(
            "geometry_msgs/msg/TransformStamped",
            header=header(parent, stamp_ns),
            child_frame_id=child,
            transform=make(
                "geometry_msgs/msg/Transform", translation=vector(x, y), rotation=turn(yaw)
            ),
        )
        for parent, child, (x, y, yaw), stamp_ns in transforms
    ]
    return make("tf2_msgs/msg/TFMessage", transforms=items)


def pose_with_covariance(x, y, yaw, covariance=0.0):
    return make(
        "geometry_msgs/msg/PoseWithCovariance",
        pose=make(
            "geometry_msgs/msg/Pose", position=vector(x, y, kind="Point"), orientation=turn(yaw)
        ),
        covariance=np.arange(36, dtype=np.float64) * covariance,
    )


def odometry(stamp_ns, x, y, yaw, frame="odom", child="base", covariance=0.0):
    still = make("geometry_msgs/msg/Twist", linear=vector(), angular=vector())
    return make(
        "nav_msgs/msg/Odometry",
        header=header(frame, stamp_ns),
        child_frame_id=child,
        pose=pose_with_covariance(x, y, yaw, covariance),
        twist=make("geometry_msgs/msg/TwistWithCovariance", twist=still, covariance=np.zeros(36)),
    )


def pose(stamp_ns, x, y, yaw, frame="map"):
    return make(
        "geometry_msgs/msg/PoseWithCovarianceStamped",
        header=header(frame, stamp_ns),
        pose=pose_with_covariance(x, y, yaw, 1.0),
    )


def cdr(message, *, little_endian=True) -> bytes:
    return bytes(STORE.serialize_cdr(message, message.__msgtype__, little_endian=little_endian))
