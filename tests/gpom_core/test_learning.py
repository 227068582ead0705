"""Learning hyperparameters: gradients against finite differences, sampled truth, limits."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from sklearn.gaussian_process import GaussianProcessRegressor
from sklearn.gaussian_process.kernels import RBF, ConstantKernel

from gpom_core.errors import ConfigurationError
from gpom_core.expert import Hyperparameters, TrainingError, train
from gpom_core.kernel_gradients import gram_with_slope
from gpom_core.kernels import gram
from gpom_core.learning import (
    LearningRule,
    learn,
    log_likelihood_with_gradient,
)
from gpom_core.observations import Observations
from gpom_core.shapes import Kind

NAMES = ("length_scale_m", "signal_std", "hit_noise_scale", "free_noise_scale")
SHARED = Hyperparameters(0.6, 1.0)


def shapes(seed: int, n: int, d: int, size_m: float = 1.0) -> tuple[np.ndarray, np.ndarray]:
    """Points, segments and boxes in turn."""
    rng = np.random.default_rng(seed)
    kinds = (np.arange(n) % 3).astype(np.uint8)
    geometry = rng.normal(size=(n, 1, d)) + size_m * rng.normal(size=(n, 2, d))
    geometry[kinds == Kind.POINT, 1] = geometry[kinds == Kind.POINT, 0]
    geometry[kinds == Kind.BOX] = np.sort(geometry[kinds == Kind.BOX], axis=1)
    return kinds, geometry


def some(seed: int = 0, n: int = 15, d: int = 2) -> Observations:
    kinds, geometry = shapes(seed, n, d)
    rng = np.random.default_rng([seed, 1])
    targets = np.where(kinds == Kind.POINT, 1.0, -1.0)
    return Observations(kinds, geometry, targets, rng.uniform(0.05, 0.5, n), np.ones(n))


def points_of_a_process(n: int, length_scale_m: float, noise_std: float) -> Observations:
    rng = np.random.default_rng(4)
    x = rng.uniform(0.0, 6.0, (n, 2))
    kinds, geometry = np.zeros(n, np.uint8), np.repeat(x[:, None], 2, axis=1)
    k = gram(kinds, geometry, length_scale_m) + 1e-9 * np.eye(n)
    y = np.linalg.cholesky(k) @ rng.normal(size=n) + noise_std * rng.normal(size=n)
    return Observations(kinds, geometry, y, np.full(n, 1.0), np.ones(n))


def differences(function, h: float = 1e-4):
    """Fourth-order central difference at 0."""
    wide, narrow = function(2 * h) - function(-2 * h), function(h) - function(-h)
    return (8 * narrow - wide) / (12 * h)


@pytest.mark.parametrize("d", [1, 2, 3])
@pytest.mark.parametrize("size_m", [1e-4, 0.02, 0.2, 1.0, 10.0])
def test_slope_of_every_kernel_is_its_finite_difference(size_m, d):
    kinds, geometry = shapes(2, 12, d, size_m)
    value, slope = gram_with_slope(kinds, geometry, 0.7)
    assert np.allclose(value, gram(kinds, geometry, 0.7), rtol=0, atol=1e-9)
    expected = differences(lambda e: gram(kinds, geometry, 0.7 * np.exp(e)))
    assert np.allclose(slope, expected, rtol=0, atol=1e-8)
    assert np.array_equal(slope, slope.T)


@given(st.integers(0, 10_000), st.tuples(st.floats(0.1, 3.0), *[st.floats(0.2, 3.0)] * 3))
def test_likelihood_gradient_is_its_finite_difference(seed, values):
    observations = some(seed)

    def at(axis: int, e: float) -> float:
        moved = [v * np.exp(e) if i == axis else v for i, v in enumerate(values)]
        return log_likelihood_with_gradient(observations, Hyperparameters(*moved))[0]

    _, gradient = log_likelihood_with_gradient(observations, Hyperparameters(*values))
    expected = [differences(lambda e, axis=axis: at(axis, e)) for axis in range(4)]
    assert np.allclose(gradient, expected, rtol=1e-5, atol=1e-5)


def test_likelihood_is_that_of_the_trained_expert():
    learned = Hyperparameters(0.4, 1.3, 0.7, 2.0)
    value, _ = log_likelihood_with_gradient(some(), learned)
    assert value == pytest.approx(train(some(), learned).log_likelihood, rel=1e-9)


def test_finds_what_scikit_learn_finds():
    data = points_of_a_process(80, length_scale_m=0.9, noise_std=0.2)
    quiet = replace(data, noise_variance=np.full(80, 0.04))
    kernel = ConstantKernel(1.0) * RBF(0.6)
    rule = LearningRule(spread=np.inf, reach=100.0, learned=("length_scale_m", "signal_std"))
    ours = learn(quiet, SHARED, rule=rule)
    theirs = GaussianProcessRegressor(kernel, alpha=0.04).fit(data.geometry[:, 0], data.targets)
    assert ours.log_likelihood == pytest.approx(theirs.log_marginal_likelihood_value_, abs=0.02)
    assert ours.converged


def test_a_pull_without_evidence_stays_with_the_shared_values():
    one = replace(some(), **{
        name: getattr(some(), name)[:1]
        for name in ("kinds", "geometry", "targets", "noise_variance", "count")
    })  # fmt: skip
    found = learn(one, SHARED, rule=LearningRule(spread=0.05)).hyperparameters
    for name in NAMES:
        assert getattr(found, name) == pytest.approx(getattr(SHARED, name), rel=0.02)


@given(st.integers(0, 200), st.floats(1.1, 4.0))
def test_never_leaves_its_bounds(seed, reach):
    rule = LearningRule(spread=np.inf, reach=reach, evaluations=20)
    found = learn(some(seed), SHARED, rule=rule).hyperparameters
    for name in NAMES:
        factor = getattr(found, name) / getattr(SHARED, name)
        assert 1 / reach * (1 - 1e-9) <= factor <= reach * (1 + 1e-9)


def test_learns_only_what_it_is_told_to():
    rule = LearningRule(learned=("length_scale_m",))
    found = learn(some(), SHARED, rule=rule).hyperparameters
    assert found.length_scale_m != SHARED.length_scale_m
    assert replace(found, length_scale_m=0.6) == SHARED


def test_a_warm_start_takes_fewer_evaluations_to_the_same_place():
    cold = learn(some(n=60), SHARED)
    warm = learn(some(n=60), SHARED, start=cold.hyperparameters)
    assert warm.evaluations < cold.evaluations
    assert warm.log_likelihood == pytest.approx(cold.log_likelihood, abs=0.05)


def test_ends_after_so_many_evaluations_with_the_best_seen():
    start = log_likelihood_with_gradient(some(n=60), SHARED)[0]
    found = learn(some(n=60), SHARED, rule=LearningRule(evaluations=3))
    assert found.evaluations == 3
    assert not found.converged
    assert found.log_likelihood > start


def test_ends_in_time():
    ticks = iter(np.arange(0.0, 100.0))
    rule = LearningRule(budget_s=2.5)
    found = learn(some(n=60), SHARED, rule=rule, clock=lambda: float(next(ticks)))
    assert 2 <= found.evaluations < learn(some(n=60), SHARED).evaluations
    assert next(ticks) == 4.0  # began at 0; 1 and 2 were in time, 3 was late
    assert not found.converged


def test_a_time_budget_needs_a_clock():
    with pytest.raises(ConfigurationError, match="clock"):
        learn(some(), SHARED, rule=LearningRule(budget_s=1.0))


def test_needs_an_observation():
    none = replace(some(), **{
        name: getattr(some(), name)[:0]
        for name in ("kinds", "geometry", "targets", "noise_variance", "count")
    })  # fmt: skip
    with pytest.raises(TrainingError, match="at least one"):
        learn(none, SHARED)


@pytest.mark.parametrize(
    "change",
    [{"spread": 0.0}, {"reach": 1.0}, {"evaluations": 0}, {"budget_s": 0.0}, {"learned": ("l",)}],
)
def test_refuses_a_rule_out_of_range(change):
    with pytest.raises(ConfigurationError, match="got"):
        LearningRule(**change)
