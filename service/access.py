"""What may be reached from where: refuses to open the map to a network without saying so."""

import ipaddress
import ssl
from typing import Any

from gpom_core.errors import ConfigurationError
from service.settings import HttpSettings, Settings, ZenohSettings

_LOCAL_NAMES = frozenset({"localhost", "localhost.localdomain"})
_WITH_CERTIFICATES = ("tls", "quic")
_LOCAL_LINKS = ("unixsock-stream/", "unixpipe/", "vsock/")


def check_exposure(settings: Settings) -> None:
    """Refuse addresses that others can reach when nothing asks them who they are.

    Raises:
        ConfigurationError: says which address, and what to set; or that rules for robots shut out
            those of ROS.
    """
    if settings.zenoh.robots and settings.ros.transports:
        message = (
            "zenoh.robots lets robots use the keys of gpom alone, so nothing that ROS says would "
            "be heard. Leave it empty, and let a router of the site say who may speak there"
        )
        raise ConfigurationError(message)
    if settings.access.insecure:
        return
    if not is_loopback(settings.http.host) and not settings.access.has_tokens:
        message = (
            f"http.host {settings.http.host} can be reached from other machines, and no tokens are "
            "set. Set access.read_tokens, write_tokens or admin_tokens, or say access.insecure: "
            "true (--insecure) when something else keeps strangers out"
        )
        raise ConfigurationError(message)
    listening = [path for path in settings.zenoh.options if path.partition("/")[0] == "listen"]
    if listening:
        message = (
            f"zenoh.options has {', '.join(listening)}, which nothing would be held against. Say "
            "where to listen in zenoh.listen"
        )
        raise ConfigurationError(message)
    exposed = [one for one in settings.zenoh.listen if not _asks_who(one, settings.zenoh)]
    if exposed:
        message = (
            f"zenoh.listen {', '.join(exposed)} can be reached from other machines, and robots "
            "need not say who they are. Set zenoh.passwords_file or certificates in zenoh.options, "
            "or say access.insecure: true (--insecure) when something else keeps strangers out"
        )
        raise ConfigurationError(message)


def check_certificate(http: HttpSettings) -> None:
    """Refuse a certificate that HTTPS cannot be served with, before anything else begins.

    Raises:
        ConfigurationError: says what is wrong with it.
    """
    certificate, key = http.tls_certificate, http.tls_key
    if certificate is None:
        if key is not None:
            message = (
                "http.tls_key is set, and http.tls_certificate is not: expected both for HTTPS"
            )
            raise ConfigurationError(message)
        return
    try:
        # Without an answer to give, it would ask the terminal for the key's password.
        ssl.create_default_context(ssl.Purpose.CLIENT_AUTH).load_cert_chain(
            certificate, key, password=""
        )
    except (OSError, ValueError) as error:  # SSLError is an OSError
        files = f"{certificate}" if key is None else f"{certificate} with the key {key}"
        message = (
            f"HTTPS cannot be served with {files}: {error.args[-1]}. http.tls_certificate and "
            "tls_key name PEM files of one certificate and its key, without a password"
        )
        raise ConfigurationError(message) from error


def is_loopback(host: str) -> bool:
    """Whether an address is reached from this machine only."""
    if host.lower() in _LOCAL_NAMES:
        return True
    try:
        return ipaddress.ip_address(host.strip("[]")).is_loopback
    except ValueError:
        return False


def _asks_who(endpoint: str, zenoh: ZenohSettings) -> bool:
    """Whether only this machine can reach an endpoint, or those who say who they are."""
    if endpoint.startswith(_LOCAL_LINKS):
        return True
    link, _, rest = endpoint.partition("/")
    host = rest.partition("#")[0].partition("?")[0].rpartition(":")[0]
    if is_loopback(host):
        return True
    if _is_multicast(host):  # there is no handshake, so nobody is asked
        return False
    mutual: Any = zenoh.options.get("transport/link/tls/enable_mtls", False)
    return zenoh.passwords_file is not None or (mutual is True and link in _WITH_CERTIFICATES)


def _is_multicast(host: str) -> bool:
    try:
        return ipaddress.ip_address(host.strip("[]")).is_multicast
    except ValueError:
        return False


def access_control(
    prefix: str, robots: tuple[str, ...], trusted: tuple[str, ...]
) -> dict[str, Any]:
    """The rules by which a robot speaks under its own name only, as zenoh's `access_control`.

    A subject is known by the name of its user or by the common name of its certificate, which is
    the name of the robot. They hold where they are configured: in the service for robots that
    connect to it, in a router for those that connect there.

    Args:
        prefix: of the site's keys.
        robots: names.
        trusted: users that may do everything, such as the service on a router.
    """
    rules = [
        _rule("answers", "egress", _DECLARATIONS, [f"{prefix}/**"]),
        _rule("map", "ingress", ["query"], [f"{prefix}/_map/query"]),
        _rule("map-reply", "egress", ["reply"], [f"{prefix}/_map/query"]),
        _rule(
            "map-alive",
            "ingress",
            ["declare_liveliness_subscriber", "liveliness_query"],
            [f"{prefix}/_map/alive"],
        ),
        _rule("map-token", "egress", ["liveliness_token"], [f"{prefix}/_map/alive"]),
        _rule("all", None, _ALL, ["**"]),
    ]
    subjects, policies = [], []
    for robot in robots:
        own = f"{prefix}/{robot}"
        rules += [
            _rule(f"{robot}-scan", "ingress", ["put"], [f"{own}/scan/*"]),
            _rule(f"{robot}-alive", "ingress", ["liveliness_token"], [f"{own}/alive"]),
            _rule(f"{robot}-ask", "ingress", ["query"], [f"{own}/cursor/*"]),
            _rule(f"{robot}-hear", "ingress", ["declare_subscriber"], [f"{own}/ack/*"]),
            _rule(f"{robot}-ack", "egress", ["put"], [f"{own}/ack/*"]),
            _rule(f"{robot}-reply", "egress", ["reply"], [f"{own}/cursor/*"]),
        ]
        kinds = ("usernames", "cert_common_names")
        subjects += [{"id": f"{robot}-{kind}", kind: [robot]} for kind in kinds]
        policies.append(
            {
                "rules": [*_SHARED, *(f"{robot}-{what}" for what in _OWN)],
                "subjects": [f"{robot}-usernames", f"{robot}-cert_common_names"],
            }
        )
    for user in trusted:
        subjects.append({"id": f"trusted-{user}", "usernames": [user]})
        policies.append({"rules": ["all"], "subjects": [f"trusted-{user}"]})
    return {
        "enabled": True,
        "default_permission": "deny",
        "rules": rules,
        "subjects": subjects,
        "policies": policies,
    }


_DECLARATIONS = ["declare_subscriber", "declare_queryable", "declare_liveliness_subscriber"]
_ALL = [
    *_DECLARATIONS, "put", "delete", "query", "reply", "liveliness_token", "liveliness_query",
]  # fmt: skip
_SHARED = ["answers", "map", "map-reply", "map-alive", "map-token"]
_OWN = ["scan", "alive", "ask", "hear", "ack", "reply"]


def _rule(name: str, flow: str | None, messages: list[str], keys: list[str]) -> dict[str, Any]:
    return {
        "id": name,
        "permission": "allow",
        "flows": ["ingress", "egress"] if flow is None else [flow],
        "messages": messages,
        "key_exprs": keys,
    }
