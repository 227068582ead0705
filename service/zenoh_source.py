"""Scans, queries and signs of life over zenoh.

The session may hang the interpreter when it is left open, and an exception in a callback loses
the sample silently: so `close` is always called, and every callback catches everything.
"""

import json
import logging
import struct
import time
from collections.abc import Callable, Mapping, Sequence
from typing import Any, Protocol, TypeVar

import zenoh

from service.access import access_control
from service.errors import SourceError
from service.problems import problem_of
from service.sequences import Cursor, SensorKey
from service.settings import ZenohSettings
from service.source import RemoteQuery, RemoteReply, SourceSink

logger = logging.getLogger(__name__)

SERVICE_CHUNK = "_map"  # stands where robots have their name, and is no robot

_CURSOR = struct.Struct("<QQ")  # boot, seq
_WILD = frozenset("*$")
_CLOSE_S = 5.0

_T = TypeVar("_T")


class Guest(Protocol):
    """Something else that uses the session of the service."""

    def attach(self, session: zenoh.Session, sink: SourceSink) -> None:
        """Declare what it needs; may raise ZError."""

    def detach(self) -> None:
        """Let go of all of it; may be called twice."""


class ZenohSource:
    """The session of the service: it listens, connects to routers, or both.

    It is a router itself. Nodes of rmw_zenoh are peers of the router beside them, and a router
    passes nothing from peer to peer: a service that was a peer too would hear none of them.
    """

    def __init__(self, settings: ZenohSettings, guests: Sequence[Guest] = ()) -> None:
        self._settings = settings
        self._guests = guests
        self._session: zenoh.Session | None = None
        self._held: list[Any] = []  # subscribers end when they are collected
        self._endpoints: tuple[str, ...] = ()

    def open(self, sink: SourceSink) -> None:
        """Open the session and declare everything; the token of the service comes last.

        Raises:
            SourceError: an address is taken, or the configuration is refused.
        """
        prefix = self._settings.prefix
        try:
            self._session = session = zenoh.open(_configuration(self._settings))
            self._held = [
                session.declare_subscriber(f"{prefix}/*/scan/*", _caught(self._on_scan(sink))),
                session.liveliness().declare_subscriber(
                    f"{prefix}/*/alive", _caught(self._on_alive(sink)), history=True
                ),
                session.declare_queryable(
                    f"{prefix}/*/cursor/*", _caught(self._on_cursor(sink)), complete=True
                ),
                session.declare_queryable(
                    f"{prefix}/{SERVICE_CHUNK}/query", _caught(self._on_query(sink)), complete=True
                ),
            ]
            for guest in self._guests:
                guest.attach(session, sink)
            token = f"{prefix}/{SERVICE_CHUNK}/alive"
            self._held.append(session.liveliness().declare_token(token))
            self._endpoints = _locators(session) if self._settings.listen else ()
        except zenoh.ZError as error:
            self.close()
            listen = ", ".join(self._settings.listen) or "nowhere"
            connect = ", ".join(self._settings.connect) or "nothing"
            message = (
                f"cannot open zenoh listening on {listen} and connecting to {connect}: {error}"
            )
            raise SourceError(message) from error

    def close(self) -> None:
        """Close the session; robots see the token of the service go."""
        for guest in self._guests:
            guest.detach()
        session, self._session = self._session, None
        self._held = []
        if session is not None:
            _close(session)

    def trouble(self) -> str | None:
        """Say when the session is closed, or has lost all it should be connected to."""
        session = self._session
        if session is None or session.is_closed():
            return "the zenoh session is closed"
        if self._settings.connect and not (session.info.routers_zid() + session.info.peers_zid()):
            return f"zenoh is not connected to {', '.join(self._settings.connect)}"
        return None

    def endpoints(self) -> tuple[str, ...]:
        """Where it really listens, with the port that was picked for port 0."""
        return self._endpoints

    def acknowledge(self, cursors: Mapping[SensorKey, Cursor]) -> None:
        """Tell robots up to which scan they are stored.

        An acknowledgement that is lost on the way is made good by the next, or by the cursor that
        robots ask for after a silence: so none waits for a robot that does not listen.
        """
        session = self._session
        if session is None:
            return
        for key, cursor in cursors.items():
            try:
                session.put(
                    f"{self._settings.prefix}/{key.robot}/ack/{key.sensor}",
                    _CURSOR.pack(*cursor),
                    congestion_control=zenoh.CongestionControl.DROP,
                    priority=zenoh.Priority.INTERACTIVE_HIGH,
                )
            except zenoh.ZError as error:
                logger.debug("robot=%s is not told of scan %d: %s", key.robot, cursor.seq, error)

    def _on_cursor(self, sink: SourceSink) -> Callable[[zenoh.Query], None]:
        def on_cursor(query: zenoh.Query) -> None:
            with query:
                names = self._names(query.key_expr)
                if names is not None:  # one stream at a time
                    cursor = sink.cursor(*names)
                    query.reply(query.key_expr, b"" if cursor is None else _CURSOR.pack(*cursor))

        return on_cursor

    def _on_scan(self, sink: SourceSink) -> Callable[[zenoh.Sample], None]:
        def on_scan(sample: zenoh.Sample) -> None:
            if sample.kind != zenoh.SampleKind.PUT:
                return
            names = self._names(sample.key_expr)
            if names is None:
                sink.on_refused("bad_key", 1)
            else:
                sink.on_scan(*names, sample.payload.to_bytes())

        return on_scan

    def _on_alive(self, sink: SourceSink) -> Callable[[zenoh.Sample], None]:
        def on_alive(sample: zenoh.Sample) -> None:
            names = self._names(sample.key_expr)
            if names is not None:
                sink.on_presence(names[0], sample.kind == zenoh.SampleKind.PUT)

        return on_alive

    def _on_query(self, sink: SourceSink) -> Callable[[zenoh.Query], None]:
        key = f"{self._settings.prefix}/{SERVICE_CHUNK}/query"

        def on_query(query: zenoh.Query) -> None:
            def reply(answer: RemoteReply) -> None:
                # Finished here at the latest: an open query makes the asker wait for its timeout.
                with query:
                    if answer.is_error:
                        query.reply_err(answer.body, encoding=answer.media_type)
                    else:
                        query.reply(key, answer.body, encoding=answer.media_type)

            try:
                sink.on_query(
                    RemoteQuery(
                        body=b"" if query.payload is None else query.payload.to_bytes(),
                        media_type=_media_type(query.encoding),
                        fusion=query.parameters.get("fusion"),
                        reply=reply,
                        method=query.parameters.get("method"),
                    )
                )
            except Exception as error:
                problem = problem_of(error)
                reply(RemoteReply(problem.encoded(), problem.MEDIA_TYPE, is_error=True))
                raise

        return on_query

    def _names(self, key: zenoh.KeyExpr) -> tuple[str, str] | None:
        """Give robot and sensor, "" if it is about all of it; None if the key names not just one.

        A put or a question may have a wildcard in its key, and then reaches us, too.
        """
        text = str(key).removeprefix(self._settings.prefix + "/")
        robot, _, rest = text.partition("/")
        if not _WILD.isdisjoint(text) or robot == SERVICE_CHUNK:
            return None
        return robot, rest.partition("/")[2]


def _media_type(encoding: zenoh.Encoding | None) -> str:
    """Without parameters, in lower case: names of media types have none (RFC 9110, 8.3.1)."""
    return "" if encoding is None else str(encoding).partition(";")[0].strip().lower()


def _caught(callback: Callable[[_T], None]) -> Callable[[_T], None]:
    def safe(item: _T) -> None:
        try:
            callback(item)
        except Exception:
            logger.exception("a zenoh callback failed; the sample is lost")

    return safe


def _configuration(settings: ZenohSettings) -> zenoh.Config:
    values: dict[str, Any] = {
        "mode": "router",
        "listen/endpoints": list(settings.listen),
        "connect/endpoints": list(settings.connect),
        # A router that is down comes back: keep trying, and say so in readiness.
        "connect/exit_on_failure": False,
        "connect/timeout_ms": -1,
        "scouting/delay": 0,  # nobody is looked for, and opening would wait half a second for that
        "scouting/multicast/enabled": False,
        "scouting/gossip/enabled": False,
        "transport/shared_memory/enabled": False,
        "adminspace/enabled": True,  # tells which port was picked for port 0
        **_identities(settings),
        **settings.options,
    }
    config = zenoh.Config()
    for path, value in values.items():
        try:
            config.insert_json5(path, json.dumps(value))
        except zenoh.ZError as error:
            shown, why = json.dumps(value), str(error)
            if "password" in path + shown:
                shown, why = "(hidden)", "it is no such value"
            message = f"zenoh refuses the option {path}: {shown}: {why}"
            raise SourceError(message) from error
    return config


def _identities(settings: ZenohSettings) -> dict[str, Any]:
    """Who the service is, and who may do what."""
    values: dict[str, Any] = {}
    if settings.passwords_file is not None:
        values["transport/auth/usrpwd/dictionary_file"] = str(settings.passwords_file)
    if settings.user is not None:
        password = "" if settings.password is None else settings.password.get_secret_value()
        values["transport/auth/usrpwd/user"] = settings.user
        values["transport/auth/usrpwd/password"] = password
    if settings.robots:
        trusted = () if settings.user is None else (settings.user,)
        values["access_control"] = access_control(settings.prefix, settings.robots, trusted)
    return values


def _locators(session: zenoh.Session) -> tuple[str, ...]:
    for reply in session.get(f"@/{session.zid()}/router", timeout=2.0):
        if reply.ok is not None:
            return tuple(json.loads(reply.ok.payload.to_bytes())["locators"])
    return ()


def _close(session: zenoh.Session) -> None:
    end_s = time.monotonic() + _CLOSE_S
    while True:
        try:
            session.close()  # type: ignore[no-untyped-call]
        except RuntimeError:  # a callback is using it: zenoh says that it is borrowed
            if time.monotonic() > end_s:
                raise
            time.sleep(0.01)
        else:
            return
