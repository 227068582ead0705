"""The expert against scikit-learn, and against itself with evidence left out."""

import numpy as np
import pytest
from sklearn.gaussian_process import GaussianProcessRegressor
from sklearn.gaussian_process.kernels import RBF, ConstantKernel

from gpom_core.errors import GpomError
from gpom_core.expert import Hyperparameters, TrainingError, train
from gpom_core.kernels import gram
from gpom_core.observations import Observations
from tests.gpom_core.synthetic import areas_observed, both, points_observed, posterior, without

HYPERPARAMETERS = Hyperparameters(length_scale_m=0.7, signal_std=1.3)


def scattered(n: int = 40, seed: int = 0) -> Observations:
    rng = np.random.default_rng(seed)
    targets = np.where(rng.random(n) < 0.4, 1.0, -1.0)
    return points_observed(rng.uniform(-2.0, 2.0, (n, 2)), targets, rng.uniform(0.05, 2.0, n))


def mixed(seed: int = 0) -> Observations:
    """Hits along a wall and free squares before it."""
    rng = np.random.default_rng(seed)
    wall = points_observed(
        np.column_stack([np.arange(0.0, 1.5, 0.1), 0.02 * rng.normal(size=15)]), np.ones(15)
    )
    x, y = np.meshgrid(np.arange(0.0, 1.5, 0.3), np.arange(-1.3, -0.2, 0.3))
    return both(wall, areas_observed(np.column_stack([x.ravel(), y.ravel()]), 0.3))


def test_mean_variance_and_likelihood_are_those_of_scikit_learn() -> None:
    o = scattered()
    kernel = ConstantKernel(1.3**2, "fixed") * RBF(0.7, "fixed")
    reference = GaussianProcessRegressor(kernel, alpha=o.noise_variance, optimizer=None)
    reference.fit(o.geometry[:, 0], o.targets)
    points = np.random.default_rng(1).uniform(-3.0, 3.0, (200, 2))
    mean, std = reference.predict(points, return_std=True)

    expert = train(o, HYPERPARAMETERS)
    got_mean, got_variance = posterior(expert, points)
    np.testing.assert_allclose(got_mean, mean, atol=1e-8)
    np.testing.assert_allclose(got_variance, std**2, atol=1e-8)
    np.testing.assert_allclose(
        expert.log_likelihood, reference.log_marginal_likelihood(), rtol=1e-10
    )


@pytest.mark.parametrize("observations", [scattered(), mixed()], ids=["points", "points and boxes"])
def test_the_precision_is_the_inverse_of_the_covariance(observations: Observations) -> None:
    expert = train(observations, HYPERPARAMETERS)
    k = 1.3**2 * gram(observations.kinds, observations.geometry, 0.7)
    k += np.diag(observations.noise_variance)
    np.testing.assert_allclose(expert.precision @ k, np.eye(len(k)), atol=1e-8)
    np.testing.assert_allclose(k @ expert.weights, observations.targets, atol=1e-8)


def test_n_observations_of_one_place_are_one_with_an_nth_of_the_noise() -> None:
    places = np.array([[0.0, 0.0], [0.5, 0.1], [1.0, -0.2]])
    targets, counts = np.array([1.0, -1.0, 1.0]), np.array([1, 5, 30])
    many = points_observed(np.repeat(places, counts, 0), np.repeat(targets, counts), 0.4)
    few = points_observed(places, targets, 0.4 / counts)
    points = np.random.default_rng(2).uniform(-1.0, 2.0, (50, 2))
    for got, expected in zip(
        posterior(train(few, HYPERPARAMETERS), points),
        posterior(train(many, HYPERPARAMETERS), points),
        strict=True,
    ):
        np.testing.assert_allclose(got, expected, atol=1e-10)


def test_left_out_observations_are_predicted_as_by_an_expert_that_never_saw_them() -> None:
    o = mixed()
    mean, variance = train(o, HYPERPARAMETERS).leave_one_out()
    signal = HYPERPARAMETERS.signal_std**2
    k = signal * gram(o.kinds, o.geometry, HYPERPARAMETERS.length_scale_m)
    for i in range(len(o)):
        rest = np.arange(len(o)) != i
        expert = train(without(o, i), HYPERPARAMETERS)
        to = k[i, rest]
        np.testing.assert_allclose(mean[i], to @ expert.weights, atol=1e-9)
        np.testing.assert_allclose(variance[i], k[i, i] - to @ expert.precision @ to, atol=1e-9)


def test_an_expert_with_one_observation_is_as_on_paper() -> None:
    expert = train(points_observed([[2.0, 3.0]], [1.0], 0.25), Hyperparameters(0.5, 1.0))
    mean, variance = posterior(expert, np.array([[2.0, 3.0], [2.5, 3.0]]))
    k = np.exp([0.0, -0.5])
    np.testing.assert_allclose(mean, k / 1.25)
    np.testing.assert_allclose(variance, 1.0 - k**2 / 1.25)
    np.testing.assert_allclose(
        expert.log_likelihood, -0.5 * (1.0 / 1.25 + np.log(1.25) + np.log(2.0 * np.pi))
    )


def test_nothing_to_train_on_is_refused() -> None:
    nothing = points_observed(np.empty((0, 2)), np.empty(0))
    with pytest.raises(TrainingError, match="at least one observation"):
        train(nothing, HYPERPARAMETERS)


@pytest.mark.parametrize("noise", [-5.0, np.nan])
def test_noise_that_makes_no_covariance_is_an_error_of_training(noise: float) -> None:
    with pytest.raises(TrainingError, match="not positive definite"):
        train(points_observed([[0.0, 0.0], [1.0, 0.0]], [1.0, -1.0], noise), HYPERPARAMETERS)
    assert issubclass(TrainingError, GpomError)


@pytest.mark.parametrize("value", [0.0, -1.0, np.nan, np.inf])
@pytest.mark.parametrize("name", ["length_scale_m", "signal_std"])
def test_hyperparameters_are_positive_numbers(name: str, value: float) -> None:
    with pytest.raises(ValueError, match=f"{name} is .*expected a positive number"):
        Hyperparameters(**{"length_scale_m": 1.0, "signal_std": 1.0} | {name: value})
