"""What an entry of a kernel matrix costs, and how that compares with numpy and scipy.special.

Prints one JSON document. The two sides of a ratio are timed in turns within one run, each at its
best, so that a busy machine slows both.
"""

import json
import time
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
import scipy.special
from numba import njit
from numpy.typing import NDArray

from gpom_core.kernels import cross_into, gram, gram_into, prior_variance_into
from gpom_core.shapes import Kind
from gpom_core.special import erf, exp_neg

SHAPES = 150
LENGTH_SCALE_M = 0.2
SIDE_M = 4.0  # of the area that a cluster covers
TURNS = 30


@njit(error_model="numpy", fastmath={"contract"})
def erf_of(x, out):
    for i in range(x.size):
        out[i] = erf(x[i])


@njit(error_model="numpy", fastmath={"contract"})
def exp_of(x, out):
    for i in range(x.size):
        out[i] = exp_neg(x[i])


def best_ns(turns: int, **work: Callable[[], Any]) -> dict[str, float]:
    """Best time of each, taken in turns, after one call each that compiles."""
    best = dict.fromkeys(work, np.inf)
    for turn in range(turns + 1):
        for name, call in work.items():
            start_ns = time.perf_counter_ns()
            call()
            if turn > 0:
                best[name] = min(best[name], time.perf_counter_ns() - start_ns)
    return best


def segments(rng: np.random.Generator, longest_m: float) -> NDArray[np.float64]:
    angle = rng.uniform(-np.pi, np.pi, SHAPES)
    length_m = longest_m * rng.uniform(0.5, 1.0, SHAPES)
    start = rng.uniform(0.0, SIDE_M, (SHAPES, 2))
    span = length_m[:, None] * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    return np.stack([start, start + span], axis=1)


def scipy_segment_gram(geometry: NDArray[np.float64], nodes: int) -> NDArray[np.float64]:
    """Equation 11 integrated along the second segment, all pairs i <= j and nodes at once."""
    a, b = (geometry / LENGTH_SCALE_M).transpose(1, 0, 2)
    length = np.linalg.norm(b - a, axis=1)
    i, j = np.triu_indices(len(a))
    closed = np.where(length[i] >= length[j], i, j)
    summed = i + j - closed
    x, w = np.polynomial.legendre.leggauss(nodes)
    node = a[summed, None] + (x[:, None] + 1.0) / 2.0 * (b - a)[summed, None]
    offset = node - a[closed, None]
    along = np.einsum("pqd,pd->pq", offset, ((b - a) / length[:, None])[closed])
    across = np.einsum("pqd,pqd->pq", offset, offset) - along**2
    limit = length[closed, None]
    reach = scipy.special.erf((limit - along) / np.sqrt(2)) + scipy.special.erf(along / np.sqrt(2))
    value = (np.exp(-0.5 * across) * reach) @ (w / 2.0) * np.sqrt(np.pi / 2) / length[closed]
    out = np.empty((len(a), len(a)))
    out[i, j] = out[j, i] = value
    return out


@pytest.mark.benchmark
@pytest.mark.parametrize("longest_m", [0.3, 0.5, 1.0, 2.0])
def test_segment_gram_against_scipy(longest_m: float) -> None:
    geometry = segments(np.random.default_rng(0), longest_m)
    kinds = np.full(SHAPES, Kind.SEGMENT, np.uint8)
    ours = gram(kinds, geometry, LENGTH_SCALE_M)
    # the fewest nodes that are as accurate as ours
    exact = scipy_segment_gram(geometry, 60)
    nodes = next(
        n for n in range(3, 60) if np.abs(scipy_segment_gram(geometry, n) - exact).max() < 1e-10
    )
    out = np.empty_like(ours)
    inverse = np.full(2, 1.0 / LENGTH_SCALE_M)
    best = best_ns(
        TURNS,
        numpy_and_scipy=lambda: scipy_segment_gram(geometry, nodes),
        gpom=lambda: gram_into(kinds, geometry, inverse, out),
    )
    ratio = best["numpy_and_scipy"] / best["gpom"]
    shown = {
        "segments": SHAPES,
        "longest_in_length_scales": longest_m / LENGTH_SCALE_M,
        "error": float(np.abs(ours - exact).max()),
        "scipy_nodes": nodes,
        "ns_per_entry": {name: round(ns / SHAPES**2, 2) for name, ns in best.items()},
        "times_faster": round(ratio, 1),
    }
    print("\n" + json.dumps(shown, indent=2))
    assert shown["error"] < 2e-10
    assert ratio > 8.0


@pytest.mark.benchmark
def test_entries_of_each_pair_of_kinds() -> None:
    rng = np.random.default_rng(0)
    points = rng.uniform(0.0, SIDE_M, (SHAPES, 2))
    corner = rng.integers(0, int(SIDE_M / 0.1), (SHAPES, 2)) * 0.1
    loose = rng.uniform(0.0, SIDE_M, (SHAPES, 2))
    families = {
        "point": (Kind.POINT, np.stack([points, points], axis=1)),
        "segment": (Kind.SEGMENT, segments(rng, 1.0)),
        "lattice box": (Kind.BOX, np.stack([corner, corner + 0.1], axis=1)),
        "loose box": (Kind.BOX, np.stack([loose, loose + rng.uniform(0.1, 0.3, (SHAPES, 2))], 1)),
    }
    inverse = np.full(2, 1.0 / LENGTH_SCALE_M)
    queries = rng.uniform(0.0, SIDE_M, (512, 2))
    shown: dict[str, dict[str, float]] = {"gram": {}, "cross": {}, "prior variance": {}}
    for name, (kind, geometry) in families.items():
        kinds = np.full(SHAPES, kind, np.uint8)
        square, wide = np.empty((SHAPES, SHAPES)), np.empty((512, SHAPES))
        best = best_ns(
            TURNS,
            gram=lambda k=kinds, g=geometry, o=square: gram_into(k, g, inverse, o),
            cross=lambda k=kinds, g=geometry, o=wide: cross_into(k, g, queries, inverse, o),
            own=lambda k=kinds, g=geometry, o=wide[0]: prior_variance_into(k, g, inverse, o),
        )
        shown["gram"][f"{name}, {name}"] = round(best["gram"] / SHAPES**2, 2)
        shown["cross"][name] = round(best["cross"] / (512 * SHAPES), 2)
        shown["prior variance"][name] = round(best["own"] / SHAPES, 1)
        for other, (other_kind, other_geometry) in families.items():
            if other_kind <= kind:
                continue
            both_kinds = np.repeat([kind, other_kind], SHAPES).astype(np.uint8)
            both = np.concatenate([geometry, other_geometry])
            room = np.empty((2 * SHAPES, 2 * SHAPES))
            mixed = best_ns(
                TURNS, ns=lambda k=both_kinds, g=both, o=room: gram_into(k, g, inverse, o)
            )
            shown["gram"][f"{name} + {other}, mixed"] = round(mixed["ns"] / (2 * SHAPES) ** 2, 2)
    print("\n" + json.dumps({"ns_per_entry": shown}, indent=2))
    assert max(shown["gram"].values()) < 200.0


@pytest.mark.benchmark
def test_special_functions_against_scipy() -> None:
    x = np.random.default_rng(0).uniform(-6.0, 6.0, 4096)
    below = -np.abs(x)
    out = np.empty_like(x)
    best = best_ns(
        300,
        erf=lambda: erf_of(x, out),
        scipy_erf=lambda: scipy.special.erf(x, out=out),
        exp_neg=lambda: exp_of(below, out),
        numpy_exp=lambda: np.exp(below, out=out),
    )
    print("\n" + json.dumps({"ns_per_element": {k: round(v / 4096, 2) for k, v in best.items()}}))
    assert best["erf"] * 3.0 < best["scipy_erf"]
