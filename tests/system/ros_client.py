"""The third party: zenoh-ros2-sdk, a client for rmw_zenoh that somebody else wrote."""

import os
from collections.abc import Callable

from tests.gpom_core.ros.samples import STORE, laser_scan, tf

# Its message sources come from git, which it asks for when it is imported; we bring our own.
os.environ.setdefault("GIT_PYTHON_REFRESH", "quiet")
os.environ["ZENOH_CONFIG_OVERRIDE"] = (
    "transport/shared_memory/enabled=false;scouting/gossip/enabled=false;listen/endpoints=[]"
)

SCAN, TF = "sensor_msgs/msg/LaserScan", "tf2_msgs/msg/TFMessage"


class RosNode:
    """Publishers and subscribers of one namespaced robot, or of a viewer."""

    def __init__(self, endpoint: str, name: str) -> None:
        self.port = int(endpoint.rsplit(":", 1)[1])
        self.name = name
        self.parts = []

    def publisher(self, topic: str, kind: str):
        from zenoh_ros2_sdk import ROS2Publisher  # noqa: PLC0415 - reads the environment

        part = ROS2Publisher(topic, kind, namespace=f"/{self.name}", **self._common(kind))
        self.parts.append(part)
        return part

    def subscribe(self, topic: str, kind: str, hear: Callable, *, latched: bool) -> None:
        from zenoh_ros2_sdk import ROS2Subscriber  # noqa: PLC0415
        from zenoh_ros2_sdk.qos import QosDurability, QosProfile  # noqa: PLC0415

        durability = QosDurability.TRANSIENT_LOCAL if latched else QosDurability.VOLATILE
        qos = QosProfile(durability=durability, history_depth=1)
        self.parts.append(ROS2Subscriber(topic, kind, hear, qos=qos, **self._common(kind)))

    def close(self) -> None:
        for part in self.parts:
            part.close()

    def _common(self, kind: str) -> dict:
        definition, _ = STORE.generate_msgdef(kind, ros_version=2)
        return {
            "msg_definition": definition,
            "type_hash": STORE.hash_rihs01(kind),
            "router_port": self.port,
            "domain_id": 0,
        }


def end_session() -> None:
    from zenoh_ros2_sdk.session import ZenohSession  # noqa: PLC0415

    ZenohSession.get_instance().close()


class RosRobot(RosNode):
    """A robot with one laser, which speaks as its drivers and its localisation would."""

    def __init__(self, endpoint: str, name: str) -> None:
        super().__init__(endpoint, name)
        self._scan = self.publisher(f"/{name}/scan", SCAN)
        self._tf = self.publisher(f"/{name}/tf", TF)
        self._static = self.publisher(f"/{name}/tf_static", TF)

    def mount(self, frame="laser") -> None:
        self._static.publish(transforms=tf(("base", frame, (0.5, 0.0, 0.0), 0)).transforms)

    def stand(self, x: float, y: float, yaw: float, stamp_ns: int) -> None:
        half = (("map", "odom", (x, y, 0.0), stamp_ns), ("odom", "base", (0, 0, yaw), stamp_ns))
        for part in half:
            self._tf.publish(transforms=tf(part).transforms)

    def scan(self, stamp_ns: int, ranges, frame="laser", **fields) -> None:
        message = laser_scan(stamp_ns, frame, ranges, **fields)
        names = (name for name in message.__dataclass_fields__ if name != "__msgtype__")
        self._scan.publish(**{name: getattr(message, name) for name in names})
