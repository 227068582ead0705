"""What can be said of the container files without a container; `make container-test` runs them."""

import json
import re
import shutil
import subprocess
from pathlib import Path

import pytest
import yaml
import zenoh

from service.map_service import MapService, Ports
from service.settings import Settings
from service.source import MemorySource

DOCKER = Path(__file__).parents[2] / "docker"
COMPOSE = sorted(DOCKER.glob("compose*.yaml"))


class Loader(yaml.SafeLoader):
    """Knows the two tags of compose files."""


for tag in ("!reset", "!override"):
    Loader.add_constructor(tag, lambda loader, node: loader.construct_sequence(node))


def services(path: Path) -> dict[str, dict]:
    return yaml.load(path.read_text(encoding="utf-8"), Loader)["services"]  # noqa: S506 - ours


def test_there_are_a_base_and_two_overlays() -> None:
    assert [path.name for path in COMPOSE] == [
        "compose.monitoring.yaml", "compose.production.yaml", "compose.yaml",
    ]  # fmt: skip


@pytest.mark.parametrize("path", COMPOSE, ids=lambda path: path.name)
def test_every_service_is_pinned_bounded_and_without_privileges(path: Path) -> None:
    for name, service in services(path).items():
        if "image" not in service:
            continue  # an overlay of one that has it
        tag = service["image"].rpartition(":")[2]
        assert re.search(r"\d", tag) or tag == "-latest}", name  # ours is built here
        assert service["cap_drop"] == ["ALL"], name
        assert service["security_opt"] == ["no-new-privileges:true"], name
        assert service["restart"] == "unless-stopped", name
        assert service["deploy"]["resources"]["limits"]["memory"], name


def test_no_port_is_open_to_a_network_unless_asked_for() -> None:
    for name in ("compose.yaml", "compose.monitoring.yaml"):
        for service in services(DOCKER / name).values():
            for port in service.get("ports", []):
                assert port.startswith("127.0.0.1:") or ":-127.0.0.1}:" in port


def test_the_dashboard_and_the_alerts_ask_for_metrics_that_exist() -> None:
    service = MapService(Settings(), Ports(MemorySource()))
    exported = service.metrics.exposition().decode()
    dashboard = json.loads((DOCKER / "grafana/gpom.json").read_text(encoding="utf-8"))
    asked = [target["expr"] for panel in dashboard["panels"] for target in panel["targets"]]
    asked.append((DOCKER / "alerts.yaml").read_text(encoding="utf-8"))
    names = set(re.findall(r"\bgpom_\w+", " ".join(asked)))

    assert len(names) > 12
    for name in names:
        family = re.sub(r"_(bucket|total)$", "", name)
        assert re.search(rf"# TYPE {family}(_total)? ", exported), name


def test_the_routers_rules_are_what_zenoh_understands() -> None:
    config = zenoh.Config.from_file(str(DOCKER / "router.production.json5"))

    assert json.loads(config.get_json("access_control/default_permission")) == "deny"
    assert json.loads(config.get_json("transport/link/tls/enable_mtls")) is True


def test_certificates_are_made_for_each_robot(tmp_path: Path) -> None:
    if shutil.which("openssl") is None:
        pytest.skip("needs openssl")
    script = shutil.copy(DOCKER / "tls/make.sh", tmp_path)
    made = ["sh", str(script), "map.example.org", "robot-1"]
    for _ in range(2):  # a second time adds what is missing and spoils nothing
        subprocess.run(made, check=True, capture_output=True, timeout=60)

    for name in ("router", "map", "proxy", "robot-1"):
        check = ["openssl", "verify", "-CAfile", tmp_path / "ca.pem", tmp_path / f"{name}.pem"]
        subprocess.run(check, check=True, capture_output=True, timeout=60)
    assert (tmp_path / "ca.key").stat().st_mode & 0o077 == 0
    token = (tmp_path / "metrics.token").read_text()
    assert re.fullmatch("[0-9a-f]{48}", token)
    assert f"Bearer {token}" in (tmp_path / "token.conf").read_text()
    assert f"READ_TOKENS={token}\n" in (tmp_path / "map.env").read_text()
