"""Robots known by their certificates: real ones, made as `docker/tls/make.sh` makes them."""

import json
import shutil
import subprocess
import time
from pathlib import Path

import pytest
import zenoh

from clients.publisher import ScanPublisher
from service.access import check_exposure
from service.map_service import MapService, Ports
from service.settings import Settings, ZenohSettings
from service.zenoh_source import ZenohSource
from tests.service.rooms import payload_at, scan_at

MAKE = Path(__file__).parents[2] / "docker" / "tls" / "make.sh"
TLS = "transport/link/tls"
PREFIX = "gpom/v1/site"


def authority(folder: Path, *robots: str) -> Path:
    """A certificate authority of its own, with certificates for a map and for robots."""
    folder.mkdir()
    script = shutil.copy(MAKE, folder)
    subprocess.run(["sh", script, "localhost", *robots], check=True, capture_output=True)  # noqa: S607
    return folder


@pytest.fixture(scope="module")
def site_authority(tmp_path_factory) -> Path:
    if shutil.which("openssl") is None:
        pytest.skip("openssl is not installed")
    return authority(tmp_path_factory.mktemp("tls") / "site", "a", "b", "unlisted")


@pytest.fixture
def site(site_authority):
    """A service that knows robots a and b."""
    zenoh_settings = ZenohSettings(
        listen=("tls/127.0.0.1:0",),
        robots=("a", "b"),
        options={
            f"{TLS}/root_ca_certificate": str(site_authority / "ca.pem"),
            f"{TLS}/listen_certificate": str(site_authority / "map.pem"),
            f"{TLS}/listen_private_key": str(site_authority / "map.key"),
            f"{TLS}/enable_mtls": True,
        },
    )
    everywhere = zenoh_settings.model_copy(update={"listen": ("tls/0.0.0.0:7447",)})
    check_exposure(Settings(zenoh=everywhere))
    source = ZenohSource(zenoh_settings)
    ports = Ports(source, acknowledge=source.acknowledge)
    service = MapService(Settings(zenoh=zenoh_settings), ports)
    service.start()
    yield service
    service.stop()


def connect(site: MapService, trusted: Path, **tls: str) -> zenoh.Session:
    (endpoint,) = site.endpoints
    config = zenoh.Config()
    for path, value in {
        "mode": "client",
        "connect/endpoints": [endpoint.replace("127.0.0.1", "localhost")],
        "connect/timeout_ms": 3000,
        "scouting/multicast/enabled": False,
        "scouting/gossip/enabled": False,
        "transport/shared_memory/enabled": False,
        f"{TLS}/root_ca_certificate": str(trusted / "ca.pem"),
        **{f"{TLS}/{name}": value for name, value in tls.items()},
    }.items():
        config.insert_json5(path, json.dumps(value))
    return zenoh.open(config)


def as_robot(site: MapService, trusted: Path, papers: Path, name: str) -> zenoh.Session:
    return connect(
        site,
        trusted,
        enable_mtls=True,
        connect_certificate=str(papers / f"{name}.pem"),
        connect_private_key=str(papers / f"{name}.key"),
    )


def test_a_robot_speaks_under_the_name_of_its_certificate_only(
    site, site_authority, eventually
) -> None:
    eventually(lambda: not site.troubles(), 300.0)
    with (
        as_robot(site, site_authority, site_authority, "a") as honest,
        as_robot(site, site_authority, site_authority, "b") as spoofer,
        as_robot(site, site_authority, site_authority, "unlisted") as unlisted,
        ScanPublisher("a", session=honest) as robot,
    ):
        for _ in range(5):
            for liar in (spoofer, unlisted):
                liar.put(f"{PREFIX}/a/scan/laser", payload_at(2.0, 2.0, seq=1, reliable=True))
                liar.put(f"{PREFIX}/a/ack/laser", bytes([255] * 16))
            unlisted.put(f"{PREFIX}/unlisted/scan/laser", payload_at(seq=1))
        time.sleep(0.5)
        assert site.scans_received == 0
        robot.publish(scan_at(0.5, 0.5))
        assert robot.drain(20.0), "the acknowledgement reaches the honest robot"
        site.flush().result(60.0)
        (known,) = site.fleet.robots()
        assert (known.id, known.scans, known.pose[:2]) == ("a", 1, (0.5, 0.5))
        with ScanPublisher("b", session=spoofer) as other:
            other.publish(scan_at())
            assert other.drain(20.0), "under its own name it is heard"


def is_let_in(open_session) -> bool:
    """Whether a session is opened, and lets a scan through."""
    try:
        with open_session() as session:
            session.put(f"{PREFIX}/a/scan/laser", payload_at(seq=1))
            time.sleep(0.5)
            return bool(session.info.peers_zid() + session.info.routers_zid())
    except zenoh.ZError:
        return False


def test_nobody_without_a_certificate_of_the_site_is_let_in(site, site_authority, tmp_path) -> None:
    strangers = authority(tmp_path / "strangers", "a")
    assert not is_let_in(lambda: connect(site, site_authority)), "no certificate"
    assert not is_let_in(lambda: as_robot(site, site_authority, strangers, "a")), "a stranger's"
    (endpoint,) = site.endpoints
    assert not is_let_in(lambda: plain(endpoint.replace("tls/", "tcp/"))), "no TLS at all"
    assert site.scans_received == 0
    assert is_let_in(lambda: as_robot(site, site_authority, site_authority, "a"))
    assert site.scans_received == 1


def test_a_robot_does_not_trust_a_map_of_another_authority(site, site_authority, tmp_path) -> None:
    strangers = authority(tmp_path / "strangers", "a")
    assert not is_let_in(lambda: as_robot(site, strangers, site_authority, "a"))


def plain(endpoint: str) -> zenoh.Session:
    config = zenoh.Config()
    for path, value in {
        "mode": "client",
        "connect/endpoints": [endpoint],
        "connect/timeout_ms": 3000,
        "scouting/multicast/enabled": False,
    }.items():
        config.insert_json5(path, json.dumps(value))
    return zenoh.open(config)
