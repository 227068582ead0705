"""Table 1: what learning and inference cost, measured, beside the theory's powers.

Against the number of observations n and the number of experts k.
"""

from collections.abc import Callable, Sequence
from dataclasses import replace
from time import process_time

import numpy as np
from numpy.typing import NDArray

from clients.paper.experiment import BOUNDS_M
from clients.paper.methods import FREE_NOISE_STD, HIT_NOISE_STD, SHARED
from gpom_core.clustering import OneCluster
from gpom_core.expert import train
from gpom_core.learning import log_likelihood_with_gradient
from gpom_core.mixture import clusters_of, predict
from gpom_core.observations import Observations
from gpom_core.scan import Scan

SIZES = (200, 400, 800, 1600)
EXPERTS = (1, 2, 4, 8, 16, 32)
THEORY = {
    "learning by n": 3.0,
    "learning by k": -2.0,
    "inference by n": 2.0,
    "inference by k": -1.0,
}
_QUERIES = 500
_REPEATS = 3


def measure_costs(
    scans: Sequence[Scan], sizes: Sequence[int] = SIZES, experts: Sequence[int] = EXPERTS
) -> dict[str, object]:
    """Times per size and per number of experts, and the powers fitted to their larger halves.

    Learning is one evaluation of likelihood and gradient of all experts; inference is mean and
    variance at 500 points by all experts, none skipped. Experts are of equal size.
    """
    every = _observations(scans)
    rng = np.random.default_rng(0)
    low, high = np.array(BOUNDS_M[:2]), np.array(BOUNDS_M[2:])
    points = rng.uniform(low, high, (_QUERIES, 2))
    largest = max(sizes)
    by_n = [_row(_parts(every, n, 1), points, n=n, k=1) for n in sizes]
    by_k = [_row(_parts(every, largest, k), points, n=largest, k=k) for k in experts]
    powers = {
        f"{what} by {axis}": _power(rows, axis, f"{what}_s")
        for axis, rows in (("n", by_n), ("k", by_k))
        for what in ("learning", "inference")
    }
    return {"by_n": by_n, "by_k": by_k, "powers": powers, "theory": THEORY}


def _observations(scans: Sequence[Scan]) -> Observations:
    """The scans cut finely enough for the largest size."""
    (cluster,) = clusters_of(
        scans,
        OneCluster(),
        length_scale_m=SHARED.length_scale_m,
        hit_noise_std=HIT_NOISE_STD,
        free_noise_std=FREE_NOISE_STD,
        segment_m=1.5,
    )
    return cluster.observations


def _parts(every: Observations, n: int, k: int) -> list[Observations]:
    """Draw n observations, cut into k equal parts from west to east."""
    chosen = np.random.default_rng(n).choice(len(every), size=min(n, len(every)), replace=False)
    chosen = chosen[np.argsort(every.geometry[chosen, :, 0].mean(axis=1))]
    return [_only(every, part) for part in np.array_split(chosen, k)]


def _only(every: Observations, which: NDArray[np.int64]) -> Observations:
    return replace(
        every,
        kinds=every.kinds[which],
        geometry=every.geometry[which],
        targets=every.targets[which],
        noise_variance=every.noise_variance[which],
        count=every.count[which],
    )


def _row(
    parts: list[Observations], points: NDArray[np.float64], *, n: int, k: int
) -> dict[str, float]:
    experts = [train(part, SHARED) for part in parts]
    return {
        "n": n,
        "k": k,
        "learning_s": _fastest(lambda: [log_likelihood_with_gradient(p, SHARED) for p in parts]),
        "inference_s": _fastest(lambda: [predict(expert, points) for expert in experts]),
    }


def _fastest(work: Callable[[], object]) -> float:
    seconds = []
    for _ in range(_REPEATS):
        started = process_time()
        work()
        seconds.append(process_time() - started)
    return min(seconds)


def _power(rows: list[dict[str, float]], axis: str, what: str) -> float:
    """Slope of the times on logarithmic axes, over the half that fixed costs matter least in."""
    half = max(2, (len(rows) + 1) // 2)
    used = rows[-half:] if axis == "n" else rows[:half]
    x, y = (np.log([max(row[name], 1e-9) for row in used]) for name in (axis, what))
    return float(np.polyfit(x, y, 1)[0])
