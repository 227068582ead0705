"""Cost follows new area, not time: per scan along a log, on its second replay, and when parked.

Processor time of one thread. Experts are trained after every ten scans, as a service under load
does. One part needs fr079 in GPOM_DATA, the other simulates a robot in twenty buildings. With
BENCH_KEEP the curves are drawn into docs/images/growth.png.
"""

import os
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from clients.protocol import read_scans
from gpom_core.mapper import Mapper
from gpom_core.scan import Scan
from tests.benchmarks import growth
from tests.benchmarks.record import Figures, record, rounded

COMMAND = "GPOM_DATA=... make bench, or pytest tests/benchmarks/test_growth.py -m benchmark -s"
IMAGE = Path(__file__).parents[2] / "docs" / "images" / "growth.png"
PARKED_SCANS = 10_000
NOISY_SCANS = 100  # of 1 cm noise, in turn
FIRST_SECOND = 10  # scans

pytestmark = [pytest.mark.benchmark, pytest.mark.timeout(7200)]


@pytest.fixture(scope="module")
def curves() -> dict[str, growth.Growth]:
    return {}


def recorded(name: str) -> list[Scan]:
    folder = os.environ.get("GPOM_DATA")
    path = Path(folder or ".") / f"{name}.corrected.log.gz"
    if not folder or not path.exists():
        pytest.skip(f"needs {path.name} in the folder named by GPOM_DATA")
    return read_scans(path)


@pytest.mark.parametrize("site", ["fr079", "campus"])
def test_cost_follows_new_area(site: str, curves: dict[str, growth.Growth]) -> None:
    scans = growth.campus() if site == "campus" else recorded(site)
    growth.replay(Mapper(), scans[:50])  # compiles
    mapper = Mapper()
    first = curves[site] = growth.replay(mapper, scans)
    again = growth.replay(mapper, scans)
    figures: Figures = {
        "scans": float(len(scans)),
        "area_m2": rounded(first.area_m2[-1]),
        "observations": float(first.observations[-1]),
        "experts": float(first.experts[-1]),
        "megabytes": rounded(first.megabytes[-1]),
        **{f"ms_per_scan_tenth_{i}": rounded(first.tenth(i)) for i in range(1, 11)},
        "last_tenth_to_first": rounded(first.tenth(10) / first.tenth(1)),
        "trainings": float(first.trained),
        "second_replay_ms_per_scan": rounded(float(np.mean(again.ms_per_scan))),
        "second_replay_more_observations": rounded(
            again.observations[-1] / first.observations[-1] - 1.0
        ),
        "second_replay_more_experts": rounded(again.experts[-1] / first.experts[-1] - 1.0),
        "second_replay_megabytes": rounded(again.megabytes[-1]),
        "second_replay_trainings": float(again.trained),
    }
    record(f"growth_{site}", COMMAND, figures)
    if os.environ.get("BENCH_KEEP") and len(curves) > 1:
        growth.draw(IMAGE, curves.items())
    assert figures["second_replay_more_observations"] < 0.05  # type: ignore[operator]


def test_a_parked_robot_costs_its_scans_and_nothing_else() -> None:
    scans = recorded("fr079")
    mapper = Mapper()
    for scan in scans[:20]:  # where it drove before
        mapper.update(scan)
    mapper.train()
    here, rng = scans[19], np.random.default_rng(0)
    ranges_m = rng.normal(here.ranges_m, 0.01, (NOISY_SCANS, len(here.ranges_m)))
    noisy = [replace(here, ranges_m=ranges) for ranges in ranges_m]
    parked = [noisy[i % NOISY_SCANS] for i in range(PARKED_SCANS)]
    for scan in parked[:FIRST_SECOND]:
        mapper.update(scan)
        mapper.train()
    experts, observations, jobs = mapper.expert_count, mapper.observation_count, 0
    integrated_s, start_s = 0.0, time.thread_time()
    for scan in parked[FIRST_SECOND:]:
        before_s = time.thread_time()
        mapper.update(scan)
        integrated_s += time.thread_time() - before_s
        taken = mapper.take_jobs(1_000_000)
        jobs += len(taken)
        mapper.swap([job.run() for job in taken])
    n = PARKED_SCANS - FIRST_SECOND
    figures: Figures = {
        "experts": float(experts),
        "experts_added": float(mapper.expert_count - experts),
        "observations_added": float(mapper.observation_count - observations),
        "trainings": float(jobs),
        "us_per_scan": rounded(1e6 * integrated_s / n),
        "us_per_scan_with_training": rounded(1e6 * (time.thread_time() - start_s) / n),
    }
    record("parked", COMMAND, figures)
    assert figures["experts_added"] == 0.0
