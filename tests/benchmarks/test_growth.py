"""Cost follows new area, not time: per scan along a log, on its second replay, and when parked.

Processor time of one thread. Experts are trained after every ten scans, as a service under load
does. Needs fr079 in GPOM_DATA; with BENCH_FULL all of its scans, else the first 2000.
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
from tests.benchmarks.record import Figures, record, rounded

COMMAND = "GPOM_DATA=... make bench, or pytest tests/benchmarks/test_growth.py -m benchmark -s"
TRAIN_EVERY = 10
PARTS = 10
SHORT = 2000
PARKED_SCANS = 10_000

pytestmark = [pytest.mark.benchmark, pytest.mark.timeout(3600)]


@pytest.fixture(scope="module")
def scans() -> list[Scan]:
    folder = os.environ.get("GPOM_DATA")
    path = Path(folder or ".") / "fr079.corrected.log.gz"
    if not folder or not path.exists():
        pytest.skip("needs fr079.corrected.log.gz in the folder named by GPOM_DATA")
    return read_scans(path)[: None if os.environ.get("BENCH_FULL") else SHORT]


def replay(mapper: Mapper, scans: list[Scan]) -> tuple[list[float], int]:
    """Seconds per scan of each tenth of the scans, and how many experts were trained."""
    costs, trained = [], 0
    for part in np.array_split(np.arange(len(scans)), PARTS):
        start_s = time.thread_time()
        for i in part.tolist():
            mapper.update(scans[i])
            if i % TRAIN_EVERY == TRAIN_EVERY - 1:
                jobs = mapper.take_jobs(1_000_000)
                trained += len(jobs)
                mapper.swap([job.run() for job in jobs])
        costs.append((time.thread_time() - start_s) / len(part))
    return costs, trained


def test_growth(scans: list[Scan]) -> None:
    replay(Mapper(), scans[:50])  # compiles
    mapper = Mapper()
    costs, trained = replay(mapper, scans)
    rows = mapper.observation_count
    again, trained_again = replay(mapper, scans)
    still = Mapper()
    for i in range(20):  # the first seconds of a robot that then stays where it is
        still.update(scans[i])
    still.train()
    parked = [
        replace(scans[19], ranges_m=noisy)
        for noisy in np.random.default_rng(0).normal(scans[19].ranges_m, 0.01, (100, 180))
    ] if len(scans[19].ranges_m) == 180 else [scans[19]] * 100  # fmt: skip
    for scan in parked[:10]:
        still.update(scan)
    still.train()
    experts, jobs = still.expert_count, 0
    start_s = time.thread_time()
    for i in range(PARKED_SCANS):
        still.update(parked[i % len(parked)])
        taken = still.take_jobs(1_000_000)
        jobs += len(taken)
        still.swap([job.run() for job in taken])
    figures: Figures = {
        "scans": float(len(scans)),
        "observations": float(rows),
        "experts": float(mapper.expert_count),
        **{f"ms_per_scan_tenth_{i}": rounded(1e3 * cost) for i, cost in enumerate(costs, 1)},
        "last_tenth_to_first": rounded(costs[-1] / costs[0]),
        "second_replay_ms_per_scan": rounded(1e3 * float(np.mean(again))),
        "second_replay_more_observations": rounded(mapper.observation_count / rows - 1.0),
        "trainings_first_replay": float(trained),
        "trainings_second_replay": float(trained_again),
        "parked_experts_added": float(still.expert_count - experts),
        "parked_trainings": float(jobs),
        "parked_us_per_scan": rounded(1e6 * (time.thread_time() - start_s) / PARKED_SCANS),
    }
    record("growth", COMMAND, figures)
    assert figures["second_replay_more_observations"] < 0.05  # type: ignore[operator]
    assert figures["parked_experts_added"] == 0.0
