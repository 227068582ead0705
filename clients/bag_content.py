"""What is in a ROS bag, opened and told by its topics: ROS 1, ROS 2 sqlite3 and ROS 2 MCAP."""

import logging
import sqlite3
import struct
import zlib
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from rosbags.highlevel import AnyReader, AnyReaderError
from rosbags.interfaces import Connection

from clients.errors import LogReadError
from gpom_core.ros import cdr

TF_TYPES = (cdr.TF_MESSAGE, "tf/msg/tfMessage")
"""The second is that of the first years of ROS 1."""

_ROS1_MAGIC = b"#ROSBAG V2.0\n"
_MAGIC = {
    _ROS1_MAGIC: "ROS 1 bag",
    b"\x89MCAP0\r\n": "ROS 2 bag (MCAP)",
    b"SQLite format 3\x00": "ROS 2 bag (sqlite3)",
}
_MOST_NAMED = 8
_REPAIRS = {
    "ROS 1 bag": "rosbag reindex",
    "ROS 2 bag (MCAP)": "mcap recover, or ros2 bag reindex for a lost metadata.yaml",
    "ROS 2 bag (sqlite3)": "ros2 bag reindex",
}
# What a damaged file makes rosbags raise, beside its own errors.
_DAMAGE = (
    AnyReaderError,
    AssertionError,
    EOFError,
    IndexError,
    KeyError,
    NotImplementedError,
    RuntimeError,
    TypeError,
    UnicodeError,
    ValueError,
    sqlite3.Error,
    struct.error,
    zlib.error,
)


@dataclass(frozen=True, slots=True)
class Bag:
    """An open bag.

    Attributes:
        path: for messages.
        kind: for people.
        reader: of its messages.
    """

    path: Path
    kind: str
    reader: AnyReader

    def topics(self, *type_names: str) -> list[Connection]:
        """Give the topics of these types that have messages; one connection for each publisher."""
        wanted = [c for c in self.reader.connections if c.msgtype in type_names and c.msgcount]
        return sorted(wanted, key=lambda connection: connection.topic)

    def messages(self, connections: Sequence[Connection]) -> Iterator[tuple[str, Any]]:
        """Give topic and message, in the order of recording.

        Raises:
            LogReadError: the file is damaged further on.
        """
        if not connections:
            return
        with _explained(self.path, self.kind):
            for connection, _, raw in self.reader.messages(connections):
                yield connection.topic, self.reader.deserialize(raw, connection.msgtype)

    def content(self) -> str:
        """List the topics, for messages."""
        counts: dict[tuple[str, str], int] = {}
        for connection in self.reader.connections:
            key = (connection.topic, connection.msgtype)
            counts[key] = counts.get(key, 0) + connection.msgcount
        named = [f"{topic} ({kind}, {count})" for (topic, kind), count in sorted(counts.items())]
        if len(named) > _MOST_NAMED:
            named = [*named[:_MOST_NAMED], f"{len(named) - _MOST_NAMED} more"]
        return ", ".join(named) or "nothing"


def bag_kind(path: Path) -> str | None:
    """Tell which kind of bag is at a path, by its content; None when it is none."""
    if path.is_dir():
        if not (path / "metadata.yaml").exists():
            return None
        files = (file for file in sorted(path.iterdir()) if file.is_file())
        return next(filter(None, map(bag_kind, files)), "ROS 2 bag")
    try:
        with path.open("rb") as file:
            start = file.read(16)
    except OSError:
        return None
    return next((kind for magic, kind in _MAGIC.items() if start.startswith(magic)), None)


@contextmanager
def open_bag(path: Path) -> Iterator[Bag]:
    """Open a bag.

    Raises:
        LogReadError: it is missing, damaged or no bag.
    """
    kind = bag_kind(path)
    if kind is None:
        message = (
            f"{path} is no ROS bag; expected a .bag, .mcap or .db3 file, or the folder of "
            "a ROS 2 bag with its metadata.yaml"
        )
        raise LogReadError(message)
    if kind == _MAGIC[_ROS1_MAGIC] and path.suffix != ".bag":
        message = f"{path} is a ROS 1 bag under another name; rename it to end with .bag"
        raise LogReadError(message)
    # rosbags tells of its own trouble with old bags; ours is one sentence.
    logging.getLogger("rosbags").setLevel(logging.ERROR)
    with _explained(path, kind):
        reader = AnyReader([path], default_typestore=cdr.types())
        reader.open()
    try:
        yield Bag(path, kind, reader)
    finally:
        reader.close()


@contextmanager
def _explained(path: Path, kind: str) -> Iterator[None]:
    try:
        yield
    except OSError as error:
        message = f"cannot read {path}: {error.strerror or error}"
        raise LogReadError(message) from error
    except _DAMAGE as error:
        cause = str(error).rstrip(".") or "its index does not fit its content"
        repair = _REPAIRS.get(kind, "ros2 bag reindex")
        message = f"{path} is damaged: {cause}; a repair may help ({repair})"
        raise LogReadError(message) from error
