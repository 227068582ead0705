"""How soon a map of a whole building answers again: process start to `/readyz`, and what it costs.

After an orderly stop the newest checkpoint is all there is to load; after a kill, here, the journal
holds as many scans beyond it. Compiled code is in its cache, as on any second start.
"""

import os
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from statistics import median

import httpx
import pytest

from tests.benchmarks.record import Figures, record, rounded
from tests.faults.parts import Service, processor_s

COMMAND = "make bench, or pytest tests/benchmarks/test_restart_speed.py -m benchmark -s"
STARTS = 3


@dataclass(frozen=True)
class Start:
    """Of one process, in s: to its first answer, to readiness, and its processor time till then."""

    answered_s: float
    ready_s: float
    processor_s: float


def replay(service: Service, log: Path, robot: str) -> None:
    command = [sys.executable, "-m", "clients.cli", "replay", str(log), "--robot", robot]
    subprocess.run([*command, "--connect", service.endpoint], check=True, timeout=1200)


def start(service: Service) -> Start:
    with httpx.Client(base_url=service.http, timeout=60.0) as client:
        began_s = time.perf_counter()
        service.start()
        answered_s = None
        while True:
            time.sleep(0.02)
            try:
                reply = client.get("/readyz")
            except httpx.TransportError:
                continue
            now_s = time.perf_counter() - began_s
            answered_s = answered_s or now_s
            if reply.is_success:
                return Start(answered_s, now_s, processor_s(service.process.pid))


def end(service: Service, number: int) -> None:
    service.send(number)
    service.process.wait(60.0)


def figures_of(name: str, starts: list[Start]) -> Figures:
    def middle(field: str) -> float:
        return rounded(median(getattr(one, field) for one in starts))

    return {
        f"{name}_first_answer_s": middle("answered_s"),
        f"{name}_ready_s": middle("ready_s"),
        f"{name}_ready_worst_s": rounded(max(one.ready_s for one in starts)),
        f"{name}_processor_s": middle("processor_s"),
    }


@pytest.fixture
def service(tmp_path) -> Iterator[Service]:
    # Saved at the end only: else what is killed may be saved before, when robots have come to rest.
    settings = tmp_path / "settings.yaml"
    settings.write_text("journal: {checkpoint_interval_s: 3600}")
    service = Service(tmp_path, "--config", str(settings))
    service.start()
    yield service
    service.kill()


@pytest.mark.benchmark
@pytest.mark.timeout(3600)
def test_a_building_answers_again(tmp_path, service) -> None:
    log = Path(os.environ.get("GPOM_DATA") or ".") / "intel.corrected.log.gz"
    if not log.exists():
        pytest.skip("needs intel.corrected.log.gz in the folder named by GPOM_DATA")
    service.wait_ready(900.0)
    replay(service, log, "first")
    before = service.flush()
    end(service, signal.SIGTERM)
    stopped, killed = [], []
    for _ in range(STARTS):
        stopped.append(start(service))
        assert service.status()["scans_integrated"] == before["scans_integrated"]
        end(service, signal.SIGTERM)
    kept = shutil.copytree(service.data, tmp_path / "kept")
    for _ in range(STARTS):
        start(service)
        replay(service, log, "second")
        service.flush()
        end(service, signal.SIGKILL)
        killed.append(start(service))
        assert service.status()["scans_integrated"] == 2 * before["scans_integrated"]
        end(service, signal.SIGKILL)
        shutil.rmtree(service.data)
        shutil.copytree(kept, service.data)
    figures: Figures = {
        "scans": float(before["scans_integrated"]),
        "experts": float(before["experts"]),
        "load_average": rounded(os.getloadavg()[0]),
        **figures_of("stopped", stopped),
        **figures_of("killed", killed),
    }
    record("restart", COMMAND, figures)
