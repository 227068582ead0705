"""The way of one stream's scans to the map service: a zenoh session, a publisher, a token."""

import json
import os
import threading
from collections.abc import Sequence
from dataclasses import dataclass
from types import TracebackType
from typing import Literal, NamedTuple, Self

import zenoh

from clients.errors import DeliveryError
from clients.keys import DEFAULT_ENDPOINT, StreamKeys
from gpom_core.errors import ConfigurationError
from gpom_core.wire import ENCODING

CONFIG_ENV = "ZENOH_CONFIG"  # by which zenoh's own tools find their configuration
_MICROSECONDS = 1e6
_MILLISECONDS = 1e3


@dataclass(frozen=True, slots=True)
class SessionSettings:
    """How to reach the site's zenoh network.

    Certificates, passwords and the like are taken from the file that ZENOH_CONFIG names.

    Attributes:
        endpoints: routers to connect to, such as `tcp/127.0.0.1:7447`.
        mode: a `client` needs a router now, a `peer` goes on looking for one.
        scouting: also look for routers by multicast.
        connect_timeout_s: how long a client waits for a router.
        stall_timeout_s: how long a put waits for a busy receiver. Past it zenoh closes the link
            and loses what was under way, so it is longer than any pause of a healthy service.
    """

    endpoints: Sequence[str] = (DEFAULT_ENDPOINT,)
    mode: Literal["client", "peer"] = "client"
    scouting: bool = False
    connect_timeout_s: float = 5.0
    stall_timeout_s: float = 60.0


class Parcel(NamedTuple):
    """A scan as it travels."""

    seq: int
    payload: bytes


def open_session(settings: SessionSettings | None = None) -> zenoh.Session:
    """Open a zenoh session; use it as a context manager, or an open one hangs the interpreter.

    Raises:
        ConfigurationError: zenoh refuses an endpoint or a number.
        DeliveryError: no router answers.
    """
    settings = settings or SessionSettings()
    if not settings.endpoints and not settings.scouting:
        message = f"no endpoint to connect to; expected one such as {DEFAULT_ENDPOINT}"
        raise ConfigurationError(message)
    try:
        config = _configure(settings)
    except zenoh.ZError as error:
        named = os.environ.get(CONFIG_ENV)
        file = f" or the file {named}" if named else ""
        message = f"zenoh refuses the endpoints {list(settings.endpoints)}{file}: {error}"
        raise ConfigurationError(message) from error
    try:
        return zenoh.open(config)
    except zenoh.ZError as error:
        message = (
            f"no zenoh router answers at {', '.join(settings.endpoints) or 'any address'} within "
            f"{settings.connect_timeout_s:g} s. Is `gpom serve` running there?"
        )
        raise DeliveryError(message) from error


class ScanLink:
    """Sends the parcels of one stream, and knows whether anyone receives them.

    zenoh neither keeps nor repeats: what is sent while `ready` is false is lost, and so may be what
    was under way when `interruptions` grew.

    Args:
        session: open; the link does not close it.
        keys: of the stream.
    """

    def __init__(self, session: zenoh.Session, keys: StreamKeys) -> None:
        self._session = session
        self._keys = keys
        self._changed = threading.Condition()
        self._map_alive = False
        self._interruptions = 0
        self._token = session.liveliness().declare_token(keys.alive)
        self._publisher = session.declare_publisher(
            keys.scan,
            encoding=ENCODING,
            congestion_control=zenoh.CongestionControl.BLOCK,
        )
        self._matching = self._publisher.declare_matching_listener(self._on_matching)
        self._presence = session.liveliness().declare_subscriber(
            keys.map_alive, self._on_presence, history=True
        )

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self.close()

    @property
    def ready(self) -> bool:
        """Whether a map service is there and subscribed to this stream."""
        return self._map_alive and self._is_matched()

    @property
    def interruptions(self) -> int:
        """How often the last subscriber went away."""
        return self._interruptions

    def wait_ready(self, timeout_s: float) -> None:
        """Wait until a map service is there and subscribed to this stream.

        Raises:
            DeliveryError: it is not within `timeout_s`.
        """
        with self._changed:
            if self._changed.wait_for(lambda: self.ready, timeout_s):
                return
            alive = self._map_alive
        missing = (
            f"the map service does not subscribe to {self._keys.scan}"
            if alive
            else f"no map service is alive under the prefix {self._keys.prefix!r}"
        )
        message = (
            f"{missing}. Is `gpom serve` running, connected to the same router and using the same "
            "prefix?"
        )
        raise DeliveryError(message)

    def send(self, parcel: Parcel) -> int:
        """Hand one parcel to zenoh; blocks while the receiver is busy. Gives its number.

        Raises:
            DeliveryError: the link or its session is closed.
        """
        try:
            self._publisher.put(parcel.payload)
        except zenoh.ZError as error:
            message = f"cannot put on {self._keys.scan}: {error}"
            raise DeliveryError(message) from error
        return parcel.seq

    def drain(self, timeout_s: float) -> bool:
        """Wait until all that was sent has left this machine.

        Closing a session drops what the receiver has not read yet. A query of lower priority than
        scans travels behind them, so its answer comes when they are through.

        Returns:
            False when it took longer than `timeout_s` or nobody receives.
        """
        if not self._is_matched():
            return False
        try:
            replies = self._session.get(
                self._keys.cursor,
                priority=zenoh.Priority.DATA_LOW,
                congestion_control=zenoh.CongestionControl.BLOCK,
                consolidation=zenoh.ConsolidationMode.NONE,
                timeout=timeout_s,
            )
            timed_out = any(
                reply.err is not None and reply.err.payload.to_bytes() == b"Timeout"
                for reply in replies
            )
        except zenoh.ZError:
            return False
        return not timed_out and self._is_matched()

    def close(self) -> None:
        """Withdraw publisher and token; the session stays open."""
        for part in (self._matching, self._presence, self._publisher, self._token):
            part.undeclare()  # type: ignore[no-untyped-call] # the stub gives no result type

    def _is_matched(self) -> bool:
        # The stub says bool; it is a MatchingStatus, which is true whatever it says.
        status = self._publisher.matching_status
        return bool(getattr(status, "matching", status))

    def _on_matching(self, status: zenoh.MatchingStatus) -> None:
        with self._changed:
            self._interruptions += not status.matching
            self._changed.notify_all()

    def _on_presence(self, sample: zenoh.Sample) -> None:
        if str(sample.key_expr) != self._keys.map_alive:
            return  # a token on a key with wildcards; it says nothing of the map
        with self._changed:
            self._map_alive = sample.kind == zenoh.SampleKind.PUT
            self._changed.notify_all()


def _configure(settings: SessionSettings) -> zenoh.Config:
    client = settings.mode == "client"
    values = {
        "mode": settings.mode,
        "connect/endpoints": list(settings.endpoints),
        "connect/timeout_ms": round(settings.connect_timeout_s * _MILLISECONDS) if client else -1,
        "connect/exit_on_failure": client,
        "listen/endpoints": [],
        "scouting/multicast/enabled": settings.scouting,
        "scouting/gossip/enabled": settings.scouting,
        # On by default from 3 kB; measured to be no faster.
        "transport/shared_memory/enabled": False,
        "transport/link/tx/queue/congestion_control/block/wait_before_close": round(
            settings.stall_timeout_s * _MICROSECONDS
        ),
    }
    # What else it takes to be let in, such as certificates, comes as zenoh's own tools take it.
    named = os.environ.get(CONFIG_ENV)
    config = zenoh.Config.from_file(named) if named else zenoh.Config()
    for key, value in values.items():
        config.insert_json5(key, json.dumps(value))
    return config
