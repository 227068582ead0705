"""Zenoh keys of ROS 2 topics, for the two ways in which ROS 2 comes over zenoh.

``rmw_zenoh``
    data ``<domain>/<topic>/<type in DDS>/<hash>``, presence
    ``@ros2_lv/<domain>/<zid>/<node>/<id>/MP/<enclave>/<namespace>/<node>/<topic>/<type>/<hash>/<qos>``
    with ``%`` for ``/``, and since Lyrical more behind it for some types. The hash differs from
    release to release (Humble has none and writes ``TypeHashNotSupported``), so it is never asked
    for.
``bridge``
    zenoh-bridge-ros2dds: data ``<topic>``, presence ``@/<zid>/@ros2_lv/MP/<topic>/<type>/<qos>``
    (before 1.0 ``@ros2_lv/<zid>/MP/…``) with ``§`` for ``/``.

Source: rmw_zenoh_cpp, ``liveliness_utils.cpp``; zenoh-plugin-ros2dds, ``liveliness_mgt.rs``.

Topics are written without their first slash, with the namespace of the robot.
"""

import re
from dataclasses import dataclass
from typing import Literal, NamedTuple

from gpom_core.errors import ConfigurationError
from gpom_core.ros import cdr

Transport = Literal["rmw_zenoh", "bridge"]

NO_HASH = "TypeHashNotSupported"
"""What Humble has in place of the hash of a type."""

_RMW_SLASH, _BRIDGE_SLASH = "%", "§"
_PLACES = {"{robot}": "robot", "{sensor}": "sensor"}
_CHUNK = re.compile(r"[^/*$#?{}\s]+")


class Origin(NamedTuple):
    """Whose topic it is; None for what its pattern does not say."""

    robot: str | None
    sensor: str | None


@dataclass(frozen=True, slots=True)
class TopicPattern:
    """A topic, or many that differ in the name of the robot and of the sensor.

    Chunks are names, ``{robot}`` and ``{sensor}`` (each one chunk, told), or ``*`` (one chunk, not
    told).

    Raises:
        ConfigurationError: it is no such pattern.
    """

    text: str

    def __post_init__(self) -> None:
        chunks = self.chunks
        plain = [chunk for chunk in chunks if chunk not in _PLACES and chunk != "*"]
        twice = any(chunks.count(place) > 1 for place in _PLACES)
        if twice or not all(_CHUNK.fullmatch(chunk) for chunk in plain):
            message = (
                f"{self.text!r} is no pattern of topics; expected names joined by single slashes, "
                "in which {robot}, {sensor} and * may stand for one name each"
            )
            raise ConfigurationError(message)

    @property
    def chunks(self) -> list[str]:
        """The names between the slashes; one at the front does not count."""
        return self.text.removeprefix("/").split("/")

    @property
    def key(self) -> str:
        """The same as a zenoh key expression."""
        return "/".join("*" if chunk in _PLACES else chunk for chunk in self.chunks)

    def match(self, topic: str) -> Origin | None:
        """Tell whose topic it is; None when it is none of these."""
        chunks, names = self.chunks, topic.removeprefix("/").split("/")
        if len(chunks) != len(names):
            return None
        found: dict[str, str] = {}
        for chunk, name in zip(chunks, names, strict=True):
            if chunk in _PLACES and _CHUNK.fullmatch(name):  # who puts to many is nobody
                found[_PLACES[chunk]] = name
            elif chunk not in {"*", name}:
                return None
        return Origin(found.get("robot"), found.get("sensor"))


def data_selector(transport: Transport, domain: int, topic: str, type_name: str) -> str:
    """Give the key expression by which to hear topics; `topic` may have ``*`` and ``**``."""
    if transport == "bridge":
        return topic
    return f"{domain}/{topic}/{cdr.dds_name(type_name)}/*"


def data_key(domain: int, topic: str, type_name: str, type_hash: str | None = None) -> str:
    """Give the key under which rmw_zenoh expects messages of a topic."""
    return f"{domain}/{topic}/{cdr.dds_name(type_name)}/{type_hash or cdr.type_hash(type_name)}"


def topic_of(transport: Transport, key: str) -> str:
    """Give the topic of a data key."""
    if transport == "bridge":
        return key
    return "/".join(key.split("/")[1:-2])


def old_cache_keys(zid: str, topic: str) -> tuple[str, ...]:
    """Give the keys by which bridges before the autumn of 2025 ask for what is latched.

    Args:
        zid: of the session that keeps it; ``*`` for all.
        topic: of the message, which answers under the key of the topic itself.
    """
    return (f"@/{zid}/@ros2_pub_cache/{topic}", f"@ros2_pub_cache/{zid}/{topic}")


def presence_selectors(transport: Transport, domain: int, type_name: str) -> tuple[str, ...]:
    """Give the key expressions of the tokens of everyone who publishes messages of a type."""
    if transport == "bridge":
        what = f"MP/*/{type_name.replace('/', _BRIDGE_SLASH)}/*"
        return (f"@/*/@ros2_lv/{what}", f"@ros2_lv/*/{what}")
    return (f"@ros2_lv/{domain}/*/*/*/MP/*/*/*/*/{cdr.dds_name(type_name)}/*/*/**",)


def topic_of_presence(transport: Transport, key: str) -> str:
    """Give the topic that a token speaks of."""
    chunks = key.split("/")
    if transport == "bridge":
        return chunks[chunks.index("MP") + 1].replace(_BRIDGE_SLASH, "/").removeprefix("/")
    return chunks[9].replace(_RMW_SLASH, "/").removeprefix("/")


def node_token(domain: int, zid: str, node: str) -> str:
    """Give the token by which the ROS graph knows a node."""
    return f"@ros2_lv/{domain}/{zid}/0/0/NN/%/%/{node}"


def publisher_token(
    domain: int, zid: str, node: str, *, number: int, topic: str, type_name: str, latched: bool
) -> str:
    """Give the token by which the ROS graph knows a reliable publisher that keeps one message."""
    qos = f":{1 if latched else ''}:,1:,:,:,,"
    where = f"@ros2_lv/{domain}/{zid}/0/{number}/MP/%/%/{node}"
    what = f"{_RMW_SLASH}{topic.replace('/', _RMW_SLASH)}/{cdr.dds_name(type_name)}"
    return f"{where}/{what}/{cdr.type_hash(type_name)}/{qos}"
