"""What the Intel map costs: ingest, training, exact queries, the field, swaps.

Times are processor time of one thread, so that other work on the machine shows less; what is
compared with something runs beside it in the same process. Needs the log in GPOM_DATA.
"""

import os
import time
from collections.abc import Callable
from pathlib import Path
from statistics import median

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.linalg import lapack

from clients.protocol import read_scans
from gpom_core.evidence import Evidence
from gpom_core.kernels import gram
from gpom_core.mapper import Mapper, TrainedExpert, TrainingJob
from gpom_core.scan import Scan
from gpom_core.snapshot import Snapshot
from gpom_core.wire import decode, encode
from tests.benchmarks.record import Figures, record, rounded

COMMAND = "GPOM_DATA=... make bench, or pytest tests/benchmarks/test_map_speed.py -m benchmark -s"
OCTREE_CELL_M = 0.1
BATCH = 100_000

pytestmark = [pytest.mark.benchmark, pytest.mark.timeout(3600)]


@pytest.fixture(scope="module")
def scans() -> list[Scan]:
    folder = os.environ.get("GPOM_DATA")
    path = Path(folder or ".") / "intel.corrected.log.gz"
    if not folder or not path.exists():
        pytest.skip("needs intel.corrected.log.gz in the folder named by GPOM_DATA")
    return read_scans(path)


@pytest.fixture(scope="module")
def mapper(scans: list[Scan]) -> Mapper:
    mapper = Mapper()
    for scan in scans:
        mapper.update(scan)
    mapper.train()
    return mapper


def cpu_s(work: Callable[[], object], turns: int = 3) -> float:
    """Median processor time of this thread; the first call, which compiles, is not counted."""
    work()
    took = []
    for _ in range(turns):
        start_s = time.thread_time()
        work()
        took.append(time.thread_time() - start_s)
    return median(took)


def in_turns(works: dict[str, Callable[[], object]], turns: int) -> dict[str, list[float]]:
    """Processor times of works that are compared: one after the other, on the same machine.

    The first turn, which compiles, is not counted.
    """
    took: dict[str, list[float]] = {name: [] for name in works}
    for turn in range(turns):
        for name, work in works.items():
            start_s = time.thread_time()
            work()
            if turn > 0:
                took[name].append(time.thread_time() - start_s)
    return took


def uniform(snapshot: Snapshot, n: int = BATCH) -> NDArray[np.float64]:
    assert snapshot.bounds is not None
    box = np.array(snapshot.bounds)
    return np.random.default_rng(0).uniform(box[:2], box[2:], (n, 2))


def visited(snapshot: Snapshot, n: int = BATCH) -> NDArray[np.float64]:
    """Points near evidence: where somebody measured, shifted by a hand's breadth."""
    rng = np.random.default_rng(1)
    members = snapshot.members.values()
    middle = np.concatenate([m.expert.observations.geometry.mean(axis=1) for m in members])
    return middle[rng.integers(0, len(middle), n)] + rng.normal(0.0, 0.1, (n, 2))


def octomap_works(scans: list[Scan]) -> dict[str, Callable[[], object]]:
    """Inserting all scans into an octree, if octomap-python is installed (extra 'compare')."""
    try:
        import octomap  # noqa: PLC0415 - not installed with the rest
    except ImportError:
        return {}
    clouds = []
    for scan in scans:
        hit = scan.hits()
        r, angle = scan.ranges_m[hit].astype(np.float64), scan.beam_angles_rad()[hit]
        ends = np.column_stack([r * np.cos(angle), r * np.sin(angle), np.zeros(len(r))])
        origin = np.array([scan.pose.x_m, scan.pose.y_m, 0.0])
        clouds.append((ends + origin, origin))

    def insert() -> None:
        tree = octomap.OcTree(OCTREE_CELL_M)
        for cloud, origin in clouds:
            tree.insertPointCloud(cloud, origin)

    return {"octomap": insert}


def test_ingest_beside_octomap(scans: list[Scan]) -> None:
    payloads = [encode(scan) for scan in scans]
    evidence = Evidence(Mapper().config)

    def ours() -> None:
        nonlocal evidence
        evidence = Evidence(Mapper().config)
        again()

    def again() -> None:
        for payload in payloads:
            evidence.add(decode(payload))

    works = {"gpom": ours, "gpom_second_replay": again, **octomap_works(scans)}
    took = in_turns(works, 6)
    per_s = {name: len(scans) / median(seconds) for name, seconds in took.items()}
    figures: Figures = {f"{name}_scans_per_s": rounded(value) for name, value in per_s.items()}
    if "octomap" in per_s:
        figures["times_faster"] = rounded(per_s["gpom"] / per_s["octomap"])
    record("ingest", COMMAND, figures)


def test_training_beside_lapack(mapper: Mapper) -> None:
    members = list(mapper.snapshot().members.values())
    jobs = [(m.expert.observations, m.expert.hyperparameters) for m in members]
    matrices = []
    for o, h in jobs:
        k = h.signal_std**2 * gram(o.kinds, o.geometry, h.length_scale_m)
        matrices.append(np.asfortranarray(k + np.diag(o.noise_variance)))

    def factorise(*, invert: bool = False) -> None:
        for k, (o, _) in zip(matrices, jobs, strict=True):
            factor, _ = lapack.dpotrf(k, lower=True, clean=False)
            if invert:
                lapack.dpotri(factor, lower=True, overwrite_c=True)
            else:
                lapack.dpotrs(factor, o.targets, lower=True)

    def kernels() -> None:
        for o, h in jobs:
            gram(o.kinds, o.geometry, h.length_scale_m)

    def whole() -> list[TrainedExpert]:
        """What the pool does."""
        return [TrainingJob(m.cluster_id, 1, *job, m.line).run()
                for m, job in zip(members, jobs, strict=True)]  # fmt: skip

    def take() -> float:
        """Processor time that handing out all jobs costs the thread that owns the mapper."""
        for m, (o, h) in zip(members, jobs, strict=True):
            mapper.fail(TrainingJob(m.cluster_id, m.revision, o, h, m.line))
        start_s = time.thread_time()
        mapper.take_jobs(len(members))
        return time.thread_time() - start_s

    invert_s, kernels_s = cpu_s(lambda: factorise(invert=True)), cpu_s(kernels)
    took = in_turns({"solve": factorise, "whole": whole}, 8)
    solve_s, whole_s = median(took["solve"]), median(took["whole"])
    ratios = np.array(took["whole"]) / np.array(took["solve"])
    record(
        "training",
        COMMAND,
        {
            "experts": float(len(jobs)),
            "observations": float(sum(len(o) for o, _ in jobs)),
            "cholesky_and_solve_s": rounded(solve_s),
            "cholesky_and_inverse_s": rounded(invert_s),
            "kernels_s": rounded(kernels_s),
            "train_all_s": rounded(whole_s),
            "take_all_jobs_s": rounded(median(take() for _ in range(4))),
            "times_cholesky_and_solve": rounded(float(np.median(ratios))),
        },
    )


def test_exact_queries(mapper: Mapper) -> None:
    snapshot = mapper.snapshot()
    figures: Figures = {}
    for name, points in (("uniform", uniform(snapshot)), ("visited", visited(snapshot))):
        for n in (BATCH, 10_000):
            seconds = cpu_s(lambda p=points[:n]: snapshot.query(p))
            figures[f"{name}_points_per_s_of_{n}"] = rounded(n / seconds)
    one = uniform(snapshot, 200)
    figures["one_point_us"] = rounded(
        1e6 / 200 * cpu_s(lambda: [snapshot.query(one[i : i + 1]) for i in range(200)])
    )
    record("exact_queries", COMMAND, figures)


def test_the_field(mapper: Mapper, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("gpom_core.field.FILL_AFTER", 1)
    filled = mapper.snapshot()
    fresh = Snapshot(prior_variance=filled.prior_variance, link=filled.link)
    snapshot = fresh.swapped(filled.members.values())
    figures: Figures = {}
    for name, points in (("uniform", uniform(snapshot)), ("visited", visited(snapshot))):
        start_s = time.thread_time()
        field = snapshot.query(points, method="field")
        figures[f"{name}_fill_s"] = rounded(time.thread_time() - start_s)
        error = abs(field.occupancy - snapshot.query(points).occupancy)
        for share in (50, 99, 99.9, 100):
            figures[f"{name}_error_p{share}"] = rounded(float(np.percentile(error, share)))
        seconds = cpu_s(lambda p=points: snapshot.query(p, method="field"), turns=9)
        figures[f"{name}_points_per_s"] = rounded(BATCH / seconds)
    held = snapshot.field()
    assert held is not None
    figures["megabytes"] = rounded(held.size_bytes / 1e6)
    box = (-10.0, -20.0, 15.6, 5.6)
    snapshot.grid(box, 0.1, method="field")
    figures["grid_256_ms"] = rounded(
        1e3 * cpu_s(lambda: snapshot.grid(box, 0.1, method="field"), turns=9)
    )
    figures["grid_256_exact_ms"] = rounded(1e3 * cpu_s(lambda: snapshot.grid(box, 0.1)))
    around = sorted(
        snapshot.members.values(),
        key=lambda m: float(np.hypot(*m.expert.observations.geometry.mean(axis=(0, 1)))),
    )[: len(snapshot.members) // 20]
    start_s = time.thread_time()
    later = snapshot.swapped(around)
    figures["swap_of_5_percent_ms"] = rounded(1e3 * (time.thread_time() - start_s))
    start_s = time.thread_time()
    later.query(uniform(snapshot), method="field")
    figures["refill_after_it_s"] = rounded(time.thread_time() - start_s)
    record("field", COMMAND, figures)
    assert figures["uniform_error_p99"] <= 0.01  # type: ignore[operator]
    assert figures["visited_error_p99"] <= 0.01  # type: ignore[operator]
