"""What robots have: publishers as rmw_zenoh and zenoh-bridge-ros2dds have them, by zenoh alone."""

from collections.abc import Iterator
from contextlib import contextmanager

import zenoh
import zenoh.ext

from gpom_core.ros import attachment
from tests.gpom_core.ros.samples import STORE, cdr
from tests.service.fleet_link import open_session


class Talker:
    """Publishes on topics of one robot."""

    def __init__(
        self, session: zenoh.Session, transport: str, *, humble: bool = False, domain: int = 0
    ) -> None:
        self.session = session
        self.transport = transport
        self.humble = humble
        self.domain = domain
        self._publishers = {}
        self._sequence = {}
        self.tokens = []

    def skip(self, topic: str) -> None:
        """Lose a message on the way."""
        self._sequence[topic] = self._sequence.get(topic, 0) + 1

    def say(self, topic: str, message, stamp_ns: int = 0) -> None:
        if topic not in self._publishers:
            self._publishers[topic] = self._declare(topic, message.__msgtype__)
        self._sequence[topic] = number = self._sequence.get(topic, 0) + 1
        beside = None
        if self.transport == "rmw_zenoh":
            beside = attachment.write(attachment.Attachment(number, stamp_ns, b"0123456789abcdef"))
        self._publishers[topic].put(cdr(message), attachment=beside)

    def appear(self, topic: str, kind: str) -> None:
        zid = self.session.zid()
        if self.transport == "bridge":
            dashed = (text.replace("/", "§") for text in (topic, kind))
            key = f"@/{zid}/@ros2_lv/MP/{'/'.join(dashed)}/:1::0,5:typehash={self._hash(kind)};"
        else:
            name = topic.replace("/", "%")
            what = f"%{name}/{_dds(kind)}/{self._hash(kind)}"
            key = f"@ros2_lv/{self.domain}/{zid}/0/9/MP/%/%/lidar/{what}/::,:,:,:,,"
        self.tokens.append(self.session.liveliness().declare_token(key))

    def vanish(self) -> None:
        for token in self.tokens:
            token.undeclare()
        self.tokens = []

    def key(self, topic: str, kind: str) -> str:
        if self.transport == "bridge":
            return topic
        return f"{self.domain}/{topic}/{_dds(kind)}/{self._hash(kind)}"

    def _declare(self, topic: str, kind: str):
        key = self.key(topic, kind)
        if not topic.endswith("tf_static"):
            return self.session.declare_publisher(key)
        return zenoh.ext.declare_advanced_publisher(
            self.session,
            key,
            cache=zenoh.ext.CacheConfig(max_samples=1),
            publisher_detection=True,
            sample_miss_detection=zenoh.ext.MissDetectionConfig(
                heartbeat=None, sporadic_heartbeat=0.5
            ),
        )

    def _hash(self, kind: str) -> str:
        return "TypeHashNotSupported" if self.humble else STORE.hash_rihs01(kind)


def _dds(kind: str) -> str:
    package, _, name = kind.split("/")
    return f"{package}::msg::dds_::{name}_"


@contextmanager
def talker(endpoint: str, transport: str, **kinds) -> Iterator[Talker]:
    with open_session(connect=endpoint) as session:
        yield Talker(session, transport, **kinds)
