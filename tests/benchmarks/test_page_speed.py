"""The live map on loopback: when the first map is there, and what a pan costs the robots.

A service with the Intel log in it, a real Chromium, and a robot that goes on sending.
"""

import os
import subprocess
import threading
import time
from pathlib import Path

import httpx
import numpy as np
import pytest

from clients.publisher import ScanPublisher
from tests.benchmarks.record import Figures, record, rounded
from tests.benchmarks.test_service_speed import (
    Site,
    gpom,
    percentiles,
    site,  # noqa: F401 - a fixture
)
from tests.browser.chromium import PROGRAM, Chromium
from tests.service.rooms import scan_at

COMMAND = "pytest tests/benchmarks/test_page_speed.py -m benchmark -s"
LOADS = 7
RATE_HZ, PHASE_S = 10.0, 15.0
PAN_TILES = 60
# When every tile of the screen has its first picture, in ms since the page was asked for.
SEEN = "window.gpom?.state.placed && !gpom.tiles._loadingTiles() && performance.now()"


def load(browser: Chromium, url: str) -> tuple[float, float]:
    """Open the page with an empty cache; when the map was there, and when all of it was final."""
    browser.call("Network.clearBrowserCache")
    browser.open(url)
    first_ms = browser.wait(SEEN, 60.0)
    return first_ms, browser.wait("gpom.tiles.settled() && performance.now()", 120.0)


class Robot(threading.Thread):
    """Sends scans of a room of its own, and notes how long each took to be stored."""

    def __init__(self, endpoint: str) -> None:
        super().__init__()
        self._endpoint = endpoint
        self._sent_s: dict[int, float] = {}
        self._end = threading.Event()
        self.stored_ms: list[float] = []

    def run(self) -> None:
        with ScanPublisher("probe", endpoints=[self._endpoint], on_durable=self._note) as publisher:
            publisher.wait_ready(60.0)
            number = 0
            while not self._end.wait(1.0 / RATE_HZ):
                number += 1
                self._sent_s[number] = time.perf_counter()
                publisher.publish(scan_at(60.0 + 0.05 * (number % 40), 0.0, room=(60.0, 0.0)))

    def end(self) -> None:
        self._end.set()
        self.join()

    def _note(self, seq: int) -> None:
        self.stored_ms.append(1e3 * (time.perf_counter() - self._sent_s[seq]))


@pytest.mark.benchmark
@pytest.mark.timeout(3600)
def test_the_first_map_and_a_pan(site: Site) -> None:  # noqa: F811 - the fixture
    log = Path(os.environ.get("GPOM_DATA", "")) / "intel.corrected.log.gz"
    if PROGRAM is None or not log.exists():
        pytest.skip("needs Chromium, and intel.corrected.log.gz in the folder named by GPOM_DATA")
    replay = gpom("replay", str(log), "--robot", "intel")
    subprocess.run((*replay, "--connect", site.zenoh), check=True, capture_output=True)
    httpx.post(f"{site.http}/v1/flush", json={"timeout_s": 300}, timeout=310).raise_for_status()
    with Chromium() as browser:
        browser.size(1280, 800)
        cold = load(browser, site.http)
        warm = [load(browser, site.http) for _ in range(LOADS)]
        robot = Robot(site.zenoh)
        robot.start()
        time.sleep(PHASE_S)
        quiet = list(robot.stored_ms)
        browser.evaluate("void gpom.map.setView([-8, 4], 7, { animate: false })")
        browser.requests.clear()
        tiles, pan_s = 0, time.monotonic()
        while tiles < PAN_TILES:
            browser.evaluate("void gpom.map.panBy([256, 64], { animate: false })")
            browser.wait("gpom.tiles._waiting.size + gpom.tiles._busy < 8", 60.0)
            tiles = len({a.partition("?")[0] for a in browser.requests if "/v1/tiles/" in a})
        browser.wait("gpom.tiles.settled()", 120.0)
        pan_s = time.monotonic() - pan_s
        panned = robot.stored_ms[len(quiet) :]
        robot.end()
        waiting = httpx.get(f"{site.http}/v1/status").json()
    figures: Figures = {
        "first_map_cold_ms": rounded(cold[0]),
        "all_tiles_cold_ms": rounded(cold[1]),
        "first_map_warm_ms": rounded(float(np.median([first for first, _ in warm]))),
        "all_tiles_warm_ms": rounded(float(np.median([last for _, last in warm]))),
        "tiles_panned": float(tiles),
        "pan_s": rounded(pan_s),
        **percentiles("stored_quiet_ms", quiet, 50, 95),
        **percentiles("stored_while_panning_ms", panned, 50, 95),
        "backlog": float(waiting["scans_received"] - waiting["scans_integrated"]),
    }
    record("page", COMMAND, figures)
