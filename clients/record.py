"""The command `gpom record`: what robots say, into a bag that `gpom replay` reads."""

from collections import Counter
from collections.abc import Iterator
from contextlib import ExitStack, suppress
from pathlib import Path
from threading import Event
from typing import Annotated, Final, Self

import typer
from rich.console import Console
from rosbags.interfaces import (
    Connection,
    Qos,
    QosDurability,
    QosHistory,
    QosLiveliness,
    QosReliability,
    QosTime,
)
from rosbags.rosbag2 import StoragePlugin, Writer

from clients.children import stop_on_signal
from clients.errors import DeliveryError
from clients.link import SessionSettings, open_session
from clients.listener import SCAN_TYPE, Heard, Listener, ListenerSettings, named
from clients.options import DEFAULT_ENDPOINTS, DEFAULT_PREFIX, Connect, Domain, Prefix, Transports
from gpom_core import wire
from gpom_core.errors import ConfigurationError, InvalidScanError
from gpom_core.ros import cdr
from gpom_core.ros.messages import write_laser_scan, write_transform
from gpom_core.transforms import from_planar

_MAP_FRAME = "map"
_BAG_VERSION: Final = 9
_NEVER = QosTime(2_147_483_647, 4_294_967_295)
# `ros2 bag play` offers topics as they were recorded; without this, who comes late to the replay
# would not hear the fixed transforms.
_LATCHED = Qos(
    QosHistory.KEEP_LAST,
    1,
    QosReliability.RELIABLE,
    QosDurability.TRANSIENT_LOCAL,
    _NEVER,
    _NEVER,
    QosLiveliness.AUTOMATIC,
    _NEVER,
    avoid_ros_namespace_conventions=False,
)


class BagRecorder:
    """A bag that is being written: ROS messages as they are, scans of gpom as scans and transforms.

    Where nothing is written, there is no bag in the end, and no folder that was made for it.

    Args:
        path: of the folder to make.

    Raises:
        ConfigurationError: there is something at the path already, or it cannot be made.
    """

    def __init__(self, path: Path) -> None:
        if path.exists():
            raise ConfigurationError(f"{path} exists already; name a folder that does not")
        self._path = path
        self._made = [folder for folder in (path, *path.parents) if not folder.exists()]
        self._writer = Writer(path, version=_BAG_VERSION, storage_plugin=StoragePlugin.MCAP)
        try:
            self._writer.open()
        except OSError as error:
            raise ConfigurationError(f"cannot write {path}: {error.strerror or error}") from error
        self._connections: dict[tuple[str, str], Connection] = {}
        self.counts: Counter[str] = Counter()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._writer.close()
        if not self.counts:
            self._remove()

    def write(self, heard: Heard) -> None:
        """Add a message; a scan of gpom that cannot be read is left out."""
        for topic, type_name, payload in _as_ros(heard):
            key = (topic, type_name)
            connection = self._connections.get(key)
            if connection is None:
                qos = [_LATCHED] if topic.endswith("tf_static") else []
                connection = self._writer.add_connection(
                    topic, type_name, typestore=cdr.types(), offered_qos_profiles=qos
                )
                self._connections[key] = connection
            self._writer.write(connection, heard.arrived_ns, payload)
            self.counts[topic] += 1

    def _remove(self) -> None:
        for name in (f"{self._path.name}.mcap", "metadata.yaml"):
            (self._path / name).unlink(missing_ok=True)
        with suppress(OSError):  # somebody else has put something there
            for folder in self._made:
                folder.rmdir()


def record(
    folder: Annotated[Path, typer.Argument(help="Folder to make, a ROS 2 bag (MCAP).")],
    seconds: Annotated[
        float | None, typer.Option(help="End after so long.  [default: on Ctrl-C]", min=0.0)
    ] = None,
    transport: Transports = None,
    domain: Domain = 0,
    connect: Connect = DEFAULT_ENDPOINTS,
    prefix: Prefix = DEFAULT_PREFIX,
) -> None:
    """Record what robots publish, so that a problem in the field can be replayed.

    Laser scans, transforms, odometry and poses of ROS 2 robots are written as they come; scans of
    gpom's own format become laser scans with transforms. Read it with gpom replay, or with ROS.
    """
    errors = Console(stderr=True)
    ways = named(transport)
    with ExitStack() as stack:
        stop: Event = stack.enter_context(stop_on_signal())
        session = stack.enter_context(open_session(SessionSettings(connect)))
        bag = stack.enter_context(BagRecorder(folder))
        listener = Listener(session, ListenerSettings(ways, domain, prefix))
        stack.callback(listener.close)
        with errors.status("recording …") as line:
            for heard in listener.messages(seconds, stop):
                bag.write(heard)
                line.update(f"recording … {bag.counts.total()} messages")
        dropped = listener.dropped
    for topic, count in sorted(bag.counts.items()):
        typer.echo(f"{topic}: {count} messages")
    if dropped:
        raise DeliveryError(f"{dropped} messages came faster than they could be written")
    if not bag.counts:
        message = (
            f"nobody published anything, so there is no bag at {folder}; `gpom doctor` may tell why"
        )
        raise DeliveryError(message)


def _as_ros(heard: Heard) -> Iterator[tuple[str, str, bytes]]:
    if heard.type_name != SCAN_TYPE:
        yield f"/{heard.topic}", heard.type_name, heard.payload
        return
    try:
        scan = wire.decode(heard.payload)
    except InvalidScanError:
        return
    frame = heard.topic
    pose = from_planar(*scan.pose)
    yield "/tf", cdr.TF_MESSAGE, write_transform(_MAP_FRAME, frame, pose, scan.stamp_ns)
    yield f"/{heard.topic}", cdr.LASER_SCAN, write_laser_scan(scan, frame)
