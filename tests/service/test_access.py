"""Strangers stay out: tokens, roles, addresses, and robots that speak for others."""

import json
import logging
import time

import pytest
import zenoh

from clients.publisher import ScanPublisher
from gpom_core.errors import ConfigurationError
from service.access import check_certificate, check_exposure
from service.errors import SourceError
from service.http.app import create_app
from service.map_service import MapService, Ports
from service.settings import AccessSettings, HttpSettings, Settings, ZenohSettings
from service.settings_file import annotated_yaml
from service.source import MemorySource
from service.zenoh_source import ZenohSource
from tests.service.rooms import payload_at, scan_at
from tests.service.web import WebClient

READ, WRITE, ADMIN = ("read-0123456789abcdef", "write-0123456789abcde", "admin-0123456789abcde")


@pytest.fixture
def guarded(eventually):
    access = AccessSettings(read_tokens=(READ,), write_tokens=(WRITE,), admin_tokens=(ADMIN,))
    app = create_app(MapService(Settings(access=access), Ports(MemorySource())))
    with WebClient(app) as client:
        eventually(lambda: client.get("/readyz").is_success)
        yield client


def bearer(token: str) -> dict[str, str]:
    return {"Authorization": f"Bearer {token}"}


@pytest.mark.parametrize("path", ["/v1/status", "/v1/query?x=0&y=0", "/metrics", "/openapi.json"])
@pytest.mark.parametrize("headers", [{}, bearer("no"), bearer(READ[:-1]), {"Authorization": READ}])
def test_questions_need_a_token(guarded, path, headers) -> None:
    reply = guarded.get(path, headers=headers)
    assert reply.status_code == 401
    assert reply.headers["www-authenticate"] == "Bearer"
    assert reply.headers["content-type"] == "application/problem+json"
    assert READ not in reply.text


def test_each_role_may_do_its_part(guarded) -> None:
    for token in (READ, WRITE, ADMIN):
        assert guarded.get("/v1/status", headers=bearer(token)).is_success
        question = {"points": [[0.0, 0.0]]}
        assert guarded.post("/v1/query", json=question, headers=bearer(token)).is_success
    assert guarded.post("/v1/flush", headers=bearer(READ)).status_code == 403
    assert guarded.post("/v1/flush", headers=bearer(WRITE)).is_success


def test_probes_need_no_token_and_show_nothing(guarded) -> None:
    assert guarded.get("/healthz").json() == {"status": "ok"}
    assert guarded.get("/readyz").is_success


def test_requests_have_ids_and_logs_have_no_secrets(guarded, caplog) -> None:
    caplog.set_level(logging.DEBUG)
    named = guarded.get("/v1/status", headers={**bearer(READ), "X-Request-Id": "mine-1"})
    assert named.headers["x-request-id"] == "mine-1"
    forged = guarded.get("/nowhere?token=" + READ, headers={"X-Request-Id": "a b\tc"})
    assert len(forged.headers["x-request-id"]) == 16
    assert "request_id=mine-1 method=GET path='/v1/status' status=200" in caplog.text
    ours = [record for record in caplog.records if record.name.startswith(("service", "uvicorn"))]
    assert ours
    assert not [record for record in ours if READ in record.getMessage()]
    assert READ not in named.text


def test_secrets_are_not_printed() -> None:
    settings = Settings(
        access=AccessSettings(read_tokens=(READ,)), zenoh=ZenohSettings(user="u", password=READ)
    )
    assert READ not in annotated_yaml(settings) + repr(settings) + str(settings.model_dump())


def test_short_tokens_are_refused() -> None:
    with pytest.raises(ValueError, match="at least 16"):
        AccessSettings(read_tokens=("short",))


@pytest.mark.parametrize(
    "parts",
    [
        {"http": {"host": "0.0.0.0"}},  # noqa: S104 - that is what is refused
        {"http": {"host": "192.168.0.7"}},
        {"http": {"host": "map.example.org"}},
        {"http": {"host": "::"}},
        {"zenoh": {"listen": ("tcp/0.0.0.0:7447",)}},
        {"zenoh": {"listen": ("tcp/127.0.0.1:1", "tls/[::]:7447")}},
        {"zenoh": {"listen": ("tcp/:7447",)}},
        {"zenoh": {"listen": ("udp/224.0.0.224:7447",), "passwords_file": "p"}},
        {
            "zenoh": {
                "listen": ("tls/0.0.0.0:7447", "tcp/0.0.0.0:7448"),
                "options": {"transport/link/tls/enable_mtls": True},
            }
        },
    ],
)
def test_addresses_that_others_reach_need_credentials(parts) -> None:
    with pytest.raises(ConfigurationError, match="can be reached from other machines"):
        check_exposure(Settings(**parts))
    check_exposure(Settings(**parts, access={"insecure": True}))


@pytest.mark.parametrize(
    "parts",
    [
        {},
        {"http": {"host": "localhost"}},
        {"http": {"host": "::1"}},
        {"http": {"host": "0.0.0.0"}, "access": {"read_tokens": (READ,)}},  # noqa: S104
        {"zenoh": {"listen": ("tcp/[::1]:7447", "tcp/127.0.0.1:0?rel=0", "unixsock-stream/x")}},
        {"zenoh": {"listen": ("tcp/0.0.0.0:7447",), "passwords_file": "p"}},
        {
            "zenoh": {
                "listen": ("tls/0.0.0.0:7447",),
                "options": {"transport/link/tls/enable_mtls": True},
            }
        },
    ],
)
def test_the_others_do_not(parts) -> None:
    check_exposure(Settings(**parts))


def session(endpoint: str, user: str, password: str) -> zenoh.Session:
    config = zenoh.Config()
    for path, value in {
        "mode": "client",
        "connect/endpoints": [endpoint],
        "connect/timeout_ms": 3000,
        "scouting/multicast/enabled": False,
        "scouting/gossip/enabled": False,
        "transport/shared_memory/enabled": False,
        "transport/auth/usrpwd/user": user,
        "transport/auth/usrpwd/password": password,
    }.items():
        config.insert_json5(path, json.dumps(value))
    return zenoh.open(config)


@pytest.mark.parametrize("path", ["listen/endpoints", "listen"])
def test_addresses_cannot_be_let_in_by_the_side_door(path) -> None:
    zenoh = {"options": {path: ["tcp/0.0.0.0:7447"]}}
    with pytest.raises(ConfigurationError, match=r"zenoh\.listen"):
        check_exposure(Settings(zenoh=zenoh))


@pytest.mark.parametrize(
    ("harm", "told"),
    [
        ("no certificate", "tls_certificate is not"),
        ("no file", "No such file"),
        ("garbage", "PEM"),
    ],
)
def test_certificates_that_cannot_be_used_are_told_before_anything_begins(
    tmp_path, harm, told
) -> None:
    path = tmp_path / "certificate.pem"
    if harm != "no file":
        path.write_text("garbage")
    http = HttpSettings(tls_certificate=None if harm == "no certificate" else path, tls_key=path)
    with pytest.raises(ConfigurationError, match=f"{told}.*"):
        check_certificate(http)


def test_options_that_zenoh_refuses_are_told_without_secrets() -> None:
    options = {"transport/auth/usrpwd": {"password": "hunter2", "bad": 1}}
    source = ZenohSource(ZenohSettings(listen=(), options=options))
    with pytest.raises(SourceError, match="transport/auth/usrpwd") as caught:
        source.open(None)
    assert "hunter2" not in str(caught.value)


def test_rules_for_robots_do_not_silently_shut_out_those_of_ros() -> None:
    settings = Settings(zenoh={"robots": ("r1",)}, ros={"transports": ("rmw_zenoh",)})
    with pytest.raises(ConfigurationError, match="nothing that ROS says would be heard"):
        check_exposure(settings)


@pytest.fixture
def site(tmp_path):
    """A service that knows robots a and b."""
    passwords = tmp_path / "passwords"
    passwords.write_text("a:secret-a\nb:secret-b\n")
    settings = Settings(
        zenoh=ZenohSettings(
            listen=("tcp/127.0.0.1:0",), passwords_file=passwords, robots=("a", "b")
        )
    )
    source = ZenohSource(settings.zenoh)
    service = MapService(settings, Ports(source, acknowledge=source.acknowledge))
    service.start()
    yield service
    service.stop()


def test_a_robot_that_speaks_for_another_is_not_heard(site, eventually) -> None:
    eventually(lambda: not site.troubles())
    (endpoint,) = site.endpoints
    with (
        session(endpoint, "a", "secret-a") as honest,
        session(endpoint, "b", "secret-b") as spoofer,
        ScanPublisher("a", session=honest) as robot,
    ):
        for _ in range(5):
            spoofer.put("gpom/v1/site/a/scan/laser", payload_at(2.0, 2.0, seq=1, reliable=True))
            spoofer.put("gpom/v1/site/a/ack/laser", bytes([255] * 16))
            spoofer.put("gpom/v1/site/_map/scan/laser", payload_at(2.0, 2.0, seq=1))
        forged = spoofer.liveliness().declare_token("gpom/v1/site/a/alive")
        time.sleep(0.5)
        assert site.scans_received == 0
        robot.publish(scan_at(0.5, 0.5))
        assert robot.drain(20.0), "the acknowledgement reaches the honest robot"
        site.flush().result(60.0)
        assert site.state.scans_integrated == site.scans_received == 1
        (known,) = site.fleet.robots()
        assert (known.id, known.scans, known.pose[:2]) == ("a", 1, (0.5, 0.5))
        with ScanPublisher("b", session=spoofer) as other:
            other.publish(scan_at())
            assert other.drain(20.0), "under its own name it is heard"
        forged.undeclare()


@pytest.mark.parametrize(("user", "password"), [("a", "wrong"), ("stranger", "x"), ("", "")])
def test_strangers_cannot_connect(site, user, password) -> None:
    (endpoint,) = site.endpoints
    with pytest.raises(zenoh.ZError):
        session(endpoint, user, password)
