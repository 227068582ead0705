"""Small ROS 2 bags, written by rosbags."""

from pathlib import Path

from rosbags.rosbag2 import StoragePlugin, Writer

from tests.gpom_core.ros.samples import STORE, S, cdr, laser_scan, tf

TYPES = {"scan": "sensor_msgs/msg/LaserScan", "tf": "tf2_msgs/msg/TFMessage"}


def write_bag(path: Path, messages, plugin=StoragePlugin.MCAP) -> Path:
    """Messages are (topic, time in ns, message)."""
    with Writer(path, version=9, storage_plugin=plugin) as bag:
        connections = {}
        for topic, stamp_ns, message in messages:
            if topic not in connections:
                connections[topic] = bag.add_connection(topic, message.__msgtype__, typestore=STORE)
            bag.write(connections[topic], stamp_ns, cdr(message))
    return path


def drive(scans=10, *, topic="/scan", frame="laser", start_ns=100 * S, **fields):
    """A robot goes along x by 1 m a second and scans five times a second."""
    yield "/tf_static", start_ns, tf(("base", frame, (0.5, 0.0, 0.0), start_ns))
    for index in range(scans):
        at = start_ns + index * S // 5
        yield "/tf", at, tf(("map", "base", (index / 5, 0.0, 0.0), at))
        yield topic, at, laser_scan(at, frame, **fields)
