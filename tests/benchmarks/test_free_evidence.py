"""Free areas beside free segments, judged on training scans that are set aside."""

from fractions import Fraction
from time import process_time

import numpy as np
import pytest

from clients.protocol import labelled_points, split, thin
from gpom_core.config import MapConfig
from gpom_core.mapper import Mapper
from gpom_core.metrics import negative_log_likelihood
from gpom_core.scan import Scan
from tests.benchmarks.logs import real_log

KINDS = {
    "areas": MapConfig(),
    "segments of 0.5 m": MapConfig(free_evidence="segments"),
    "segments of 0.25 m": MapConfig(free_evidence="segments", segment_m=0.25),
}
SHARES = (Fraction(1), Fraction(1, 3), Fraction(1, 10))
SET_ASIDE = slice(3, None, 9)  # of the training scans
POINTS = 20_000


def trained(scans: list[Scan], config: MapConfig) -> tuple[Mapper, float]:
    """A map that waits for its experts to be swapped in, and how long they took, ms of one core."""
    mapper = Mapper(config)
    for scan in scans:
        mapper.update(scan)
    started = process_time()
    done = [job.run() for job in mapper.take_jobs(mapper.expert_count)]
    spent_ms = 1e3 * (process_time() - started)
    mapper.swap(done)
    return mapper, spent_ms


@pytest.mark.benchmark
@pytest.mark.timeout(1800)
@pytest.mark.parametrize("log", ["intel", "fr101", "aces"])
def test_free_evidence(log: str) -> None:
    training, _ = split(real_log(log))
    aside = training[SET_ASIDE]
    rest = [scan for scan in training if scan not in aside]
    test = labelled_points(aside, seed=0, keep=POINTS)
    for config in KINDS.values():  # compiles
        trained(rest[:3], config)[0].train()
    for share in SHARES:
        for kind, config in KINDS.items():
            mapper, training_ms = trained(thin(rest, share), config)
            snapshot = mapper.train()
            started = process_time()
            occupancy = snapshot.query(test.points).occupancy
            query_us = 1e6 * (process_time() - started) / len(test)
            nll = negative_log_likelihood(occupancy, test.occupied)
            members = snapshot.members.values()
            observations = sum(len(member.expert.observations) for member in members)
            gained = 1e6 * (np.log(2.0) - nll)
            print(
                f"\n| {log} | {share} | {kind} | {nll:.4f} | {observations} | {training_ms:.0f} "
                f"| {gained / observations:.1f} | {gained / training_ms:.0f} | {query_us:.0f} |",
                end="", flush=True,
            )  # fmt: skip
