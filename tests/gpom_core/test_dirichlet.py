"""Dirichlet process clustering: the density against scipy's, the posterior against enumeration."""

from collections import Counter

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.stats import multivariate_t

from gpom_core.dirichlet import NormalInverseWishart, log_joint, sample_clusters
from gpom_core.errors import ConfigurationError


def prior(d: int = 2, extent_m: float = 0.7) -> NormalInverseWishart:
    return NormalInverseWishart(np.full(d, 0.3), 0.2, d + 2.0, np.eye(d) * extent_m**2)


def blobs(rng: np.random.Generator, d: int = 2) -> tuple[np.ndarray, np.ndarray]:
    truth = np.repeat(np.arange(4), 30)
    centres = 8.0 * np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [1, 1, 1]], np.float64)[:, :d]
    return centres[truth] + 0.4 * rng.normal(size=(len(truth), d)), truth


@pytest.mark.parametrize("d", [1, 2, 3])
def test_density_is_the_chain_of_student_t_predictives(d):
    rng = np.random.default_rng(d)
    x, base = rng.normal(size=(6, d)), prior(d)
    expected = 0.0
    for i in range(len(x)):
        seen = x[:i]
        k, f = base.strength + i, base.degrees + i
        mean = (base.strength * base.mean_m + seen.sum(axis=0)) / k
        centred = seen - (seen.mean(axis=0) if i else 0.0)
        shift = (seen.mean(axis=0) if i else base.mean_m) - base.mean_m
        scatter = base.scatter_m2 + centred.T @ centred
        scatter = scatter + base.strength * i / k * np.outer(shift, shift)
        freedom = f - d + 1
        t = multivariate_t(mean, scatter * (k + 1) / (k * freedom), df=freedom)
        expected += t.logpdf(x[i]) + np.log((i or 1.5) / (i + 1.5))
    assert log_joint(x, np.zeros(6, np.int64), base, 1.5) == pytest.approx(expected, abs=1e-9)


def partitions(n: int) -> list[tuple[int, ...]]:
    found = [(0,)]
    for _ in range(n - 1):
        found = [(*p, k) for p in found for k in range(max(p) + 2)]
    return found


def test_samples_follow_the_exact_posterior():
    x = np.array([[0.0, 0.0], [0.4, 0.1], [1.9, 0.3], [2.4, -0.2]])
    every = partitions(4)
    log_p = np.array([log_joint(x, np.array(p), prior()) for p in every])
    exact = np.exp(log_p - log_p.max())
    exact /= exact.sum()
    # partitions of equal density are told apart by nothing that is returned, so count densities
    _, history = sample_clusters(x, prior(), sweeps=10_000, seed=3)
    seen = Counter(np.round(history, 9).tolist())
    for value in np.unique(np.round(log_p, 9)):
        p = exact[np.round(log_p, 9) == value].sum()
        assert seen[float(value)] / 10_000 == pytest.approx(p, abs=0.02)


@given(st.permutations(range(5)))
def test_density_does_not_depend_on_the_order_of_the_points(order):
    x = np.random.default_rng(1).normal(size=(5, 2))
    labels = np.array([0, 1, 0, 2, 1])
    shuffled = log_joint(x[order], labels[order], prior())
    assert shuffled == pytest.approx(log_joint(x, labels, prior()), abs=1e-9)


@pytest.mark.parametrize("offset_m", [0.0, 1e6])
@pytest.mark.parametrize("d", [2, 3])
def test_finds_the_number_of_clusters(d, offset_m):
    x, truth = blobs(np.random.default_rng(0), d)
    x = x + offset_m
    labels, history = sample_clusters(x, NormalInverseWishart.around(x, 0.5), sweeps=150)
    assert np.array_equal(labels, truth)  # labels come in order of appearance
    assert history.max() == pytest.approx(
        log_joint(x, labels, NormalInverseWishart.around(x, 0.5)), abs=1e-4
    )


def test_same_seed_same_clusters():
    x, _ = blobs(np.random.default_rng(5))
    base = NormalInverseWishart.around(x, 0.3)
    first, again = (sample_clusters(x, base, sweeps=5, seed=7)[0] for _ in range(2))
    assert np.array_equal(first, again)


def test_more_concentration_more_clusters():
    x = np.random.default_rng(2).normal(size=(60, 2))
    few, many = (
        sample_clusters(x, prior(extent_m=0.2), concentration=c, sweeps=40)[0].max()
        for c in (1e-3, 1e2)
    )
    assert few < many


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"strength": 0.0}, "strength"),
        ({"degrees": 1.0}, "degrees"),
        ({"scatter_m2": np.zeros((2, 2))}, "positive definite"),
        ({"scatter_m2": np.eye(3)}, "shape"),
    ],
)
def test_refuses_a_prior_that_is_none(change, message):
    good = {"mean_m": np.zeros(2), "strength": 1.0, "degrees": 4.0, "scatter_m2": np.eye(2)}
    with pytest.raises(ConfigurationError, match=message):
        NormalInverseWishart(**(good | change))


@pytest.mark.parametrize("change", [{"concentration": 0.0}, {"sweeps": 0}])
def test_refuses_settings_out_of_range(change):
    with pytest.raises(ConfigurationError, match="expected more than 0"):
        sample_clusters(np.zeros((3, 2)), prior(), **change)


def test_refuses_points_of_another_dimension():
    with pytest.raises(ConfigurationError, match=r"\(n, 2\)"):
        sample_clusters(np.zeros((3, 3)), prior())
