"""The overlay for production, but for the containers: its router, its certificates, its rules."""

import json
import shutil
import socket
import subprocess
from collections.abc import Iterator
from pathlib import Path

import pytest
import yaml
import zenoh

from clients.errors import DeliveryError
from clients.publisher import ScanPublisher
from service.map_service import MapService, Ports
from service.settings import Settings
from service.zenoh_source import ZenohSource
from tests.containers.test_files import DOCKER, services
from tests.service.conftest import wait_until
from tests.service.rooms import scan_at

pytestmark = pytest.mark.skipif(shutil.which("openssl") is None, reason="needs openssl")


@pytest.fixture(scope="module")
def tls(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Certificates of a site with two robots, of which the router knows the first."""
    folder = tmp_path_factory.mktemp("tls")
    script = shutil.copy(DOCKER / "tls/make.sh", folder)
    made = ["sh", str(script), "map.example.org", "robot-1", "robot-2"]
    subprocess.run(made, check=True, capture_output=True, timeout=60)
    return folder


@pytest.fixture(scope="module")
def router(tls: Path) -> Iterator[str]:
    """The router of the overlay; where it listens."""
    text = (DOCKER / "router.production.json5").read_text(encoding="utf-8")
    with socket.create_server(("127.0.0.1", 0)) as probe:
        address = f"localhost:{probe.getsockname()[1]}"
    file = tls / "router.json5"
    file.write_text(text.replace('"/tls/', f'"{tls}/').replace("0.0.0.0:7447", address))
    with zenoh.open(zenoh.Config.from_file(str(file))):
        yield f"tls/{address}"


@pytest.fixture(scope="module")
def site(tls: Path, router: str) -> Iterator[MapService]:
    """A service with the zenoh settings that the overlay gives it."""
    environment = services(DOCKER / "compose.production.yaml")["map"]["environment"]
    options = yaml.safe_load(environment["GPOM_ZENOH__OPTIONS"].replace('"/tls/', f'"{tls}/'))
    settings = Settings(zenoh={"listen": (), "connect": (router,), "options": options})
    source = ZenohSource(settings.zenoh)
    service = MapService(settings, Ports(source, acknowledge=source.acknowledge))
    service.start()
    yield service
    service.stop()


def be(robot: str, tls: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Let clients use the configuration of a robot."""
    text = (DOCKER / "robot.production.json5").read_text(encoding="utf-8")
    file = tls / f"{robot}.json5"
    file.write_text(text.replace('"/tls/', f'"{tls}/').replace("robot-1", robot))
    monkeypatch.setenv("ZENOH_CONFIG", str(file))


def test_a_robot_with_a_certificate_is_heard(
    site: MapService, tls: Path, router: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    wait_until(lambda: not site.troubles())
    be("robot-1", tls, monkeypatch)
    with ScanPublisher("robot-1", endpoints=[router]) as robot:
        robot.wait_ready(30.0)
        robot.publish(scan_at(0.5, 0.5))
        assert robot.drain(30.0), "the acknowledgement comes back"
    assert {known.id for known in site.fleet.robots()} == {"robot-1"}


def test_a_robot_speaks_under_its_own_name_only(
    site: MapService, tls: Path, router: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("clients.publisher.CLOSE_TIMEOUT_S", 0.1)
    be("robot-1", tls, monkeypatch)
    with ScanPublisher("robot-2", endpoints=[router]) as liar:
        liar.publish(scan_at(0.5, 0.5))
        assert not liar.drain(3.0)
    be("robot-2", tls, monkeypatch)  # a good certificate, but no rule
    with ScanPublisher("robot-2", endpoints=[router]) as stranger:
        stranger.publish(scan_at(0.5, 0.5))
        assert not stranger.drain(3.0)
    assert "robot-2" not in {known.id for known in site.fleet.robots()}


def test_without_a_certificate_nobody_connects(
    router: str, tls: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    file = tmp_path / "stranger.json5"
    trust = {"root_ca_certificate": str(tls / "ca.pem")}
    file.write_text(json.dumps({"transport": {"link": {"tls": trust}}}))
    monkeypatch.setenv("ZENOH_CONFIG", str(file))
    with pytest.raises(DeliveryError), ScanPublisher("robot-1", endpoints=[router]):
        pass
