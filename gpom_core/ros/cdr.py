"""ROS 2 messages from and to CDR bytes, without ROS, by the types of `rosbags`.

Only plain CDR (XCDR version 1) is spoken, big and little endian: it is what ROS 2 sends. Lengths
in a message are claims, held against the size of the payload before anything is allocated.
"""

from functools import cache
from typing import Any, Final

from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from rosbags.typesys.store import Typestore

from gpom_core.errors import RosMessageError

LASER_SCAN: Final = "sensor_msgs/msg/LaserScan"
TF_MESSAGE: Final = "tf2_msgs/msg/TFMessage"
ODOMETRY: Final = "nav_msgs/msg/Odometry"
POSE: Final = "geometry_msgs/msg/PoseWithCovarianceStamped"
OCCUPANCY_GRID: Final = "nav_msgs/msg/OccupancyGrid"
GRID_UPDATE: Final = "map_msgs/msg/OccupancyGridUpdate"

MESSAGE_BYTES_MAX = 16 * 2**20
"""Largest message that is read."""

_HEADER_BYTES = 4
_PLAIN = (0x00, 0x01)
_OTHERS = {
    0x02: "parameter lists (PL_CDR)",
    0x03: "parameter lists (PL_CDR)",
    0x06: "XCDR version 2",
    0x07: "XCDR version 2",
    0x08: "XCDR version 2, delimited",
    0x09: "XCDR version 2, delimited",
    0x0A: "XCDR version 2, parameter lists",
    0x0B: "XCDR version 2, parameter lists",
}
# Not among the types that come with rosbags.
_GRID_UPDATE_DEFINITION = """
std_msgs/Header header
int32 x
int32 y
uint32 width
uint32 height
int8[] data
"""


@cache
def types() -> Typestore:
    """Give the types of ROS 2 messages; what is used of them has not changed since Humble."""
    store = get_typestore(Stores.ROS2_HUMBLE)
    store.register(get_types_from_msg(_GRID_UPDATE_DEFINITION, GRID_UPDATE))
    return store


def make(type_name: str, **fields: Any) -> Any:
    """Make a message of a type such as ``std_msgs/msg/Header``."""
    return types().types[type_name](**fields)


def decode(payload: bytes, type_name: str) -> Any:
    """Read a message.

    Raises:
        RosMessageError: ``too_large``, ``truncated``, ``unsupported_encoding`` or ``bad_cdr``.
    """
    _check_frame(payload)
    try:
        return types().deserialize_cdr(payload, type_name)
    except Exception as error:  # generated code meets hostile bytes in many ways
        message = f"{len(payload)} bytes are no {type_name}: {error}"
        raise RosMessageError("bad_cdr", message) from error


def encode(message: Any, type_name: str) -> bytes:
    """Write a message, little endian."""
    return bytes(types().serialize_cdr(message, type_name))


@cache
def type_hash(type_name: str) -> str:
    """Give the type's hash as ROS 2 writes it since Iron (REP 2016), ``RIHS01_…``."""
    return types().hash_rihs01(type_name)


@cache
def dds_name(type_name: str) -> str:
    """Give the type's name in DDS: ``std_msgs/msg/Header`` is ``std_msgs::msg::dds_::Header_``."""
    package, kind, name = type_name.split("/")
    return f"{package}::{kind}::dds_::{name}_"


def _check_frame(payload: bytes) -> None:
    if len(payload) > MESSAGE_BYTES_MAX:
        message = f"{len(payload)} bytes; at most {MESSAGE_BYTES_MAX} are read"
        raise RosMessageError("too_large", message)
    if len(payload) < _HEADER_BYTES:
        message = f"{len(payload)} bytes; expected at least the CDR header of {_HEADER_BYTES}"
        raise RosMessageError("truncated", message)
    kind = int.from_bytes(payload[:2], "big")
    if kind not in _PLAIN:
        name = _OTHERS.get(kind, f"encapsulation 0x{kind:04x}")
        message = f"the message is encoded as {name}; expected plain CDR (0x0000 or 0x0001)"
        raise RosMessageError("unsupported_encoding", message)
