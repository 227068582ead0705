"""The expert: the Gaussian process of one cluster (eq. 8-10 of Kim & Kim, Sensors 2022)."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from math import inf, isfinite
from typing import Final

import numpy as np
from numpy.typing import NDArray

from gpom_core.errors import GpomError
from gpom_core.inverse import addresses_for, padded, solve_and_pack, unpacked
from gpom_core.jit import compiled
from gpom_core.kernels import gram
from gpom_core.observations import Observations

Gram = Callable[[NDArray[np.uint8], NDArray[np.float64], float], NDArray[np.float64]]
"""Kernel between all pairs of shapes, as `kernels.gram`."""

_LOG_TWO_PI: Final = 1.8378770664093453


class TrainingError(GpomError):
    """An expert could not be trained; its covariance is not positive definite."""


@dataclass(frozen=True, slots=True)
class Hyperparameters:
    """Of one expert: its kernel, and how far to believe its evidence.

    Attributes:
        length_scale_m, signal_std: of the kernel (eq. 6).
        hit_noise_scale, free_noise_scale: factors on the noise's standard deviation, of hits and
            of free evidence.
    """

    length_scale_m: float
    signal_std: float
    hit_noise_scale: float = 1.0
    free_noise_scale: float = 1.0

    def __post_init__(self) -> None:
        for name in ("length_scale_m", "signal_std", "hit_noise_scale", "free_noise_scale"):
            value = getattr(self, name)
            if not 0.0 < value < inf:
                raise ValueError(f"{name} is {value}, expected a positive number")

    def noise_variance(self, observations: Observations) -> NDArray[np.float64]:
        """Noise of each observation, (n,)."""
        if self.hit_noise_scale == self.free_noise_scale == 1.0:
            return observations.noise_variance
        hit = observations.targets > 0.0
        scale = np.where(hit, self.hit_noise_scale, self.free_noise_scale)
        return np.asarray(observations.noise_variance * scale**2)


@dataclass(frozen=True, slots=True, eq=False)
class Expert:
    """A trained expert over n observations; immutable.

    Attributes:
        observations: with the noise that the expert was trained with.
        weights: (n,) alpha = K^-1 y, where K holds the noise.
        packed: (n (n + 1) / 2,) upper triangle of K^-1, row by row.
        log_likelihood: log marginal likelihood of the targets.
    """

    observations: Observations
    hyperparameters: Hyperparameters
    weights: NDArray[np.float64]
    packed: NDArray[np.float64]
    log_likelihood: float

    @property
    def precision(self) -> NDArray[np.float64]:
        """K^-1, (n, n), made anew each time."""
        return unpacked(self.packed, len(self.weights))

    def leave_one_out(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Latent mean and variance at each observation when it is left out, (n,) each.

        DESIGN's m = y - [K^-1 y] / [K^-1]_ii and v = 1 / [K^-1]_ii, the observation's own noise
        taken off the variance (Rasmussen & Williams, section 5.4.2).
        """
        n = len(self.weights)
        diagonal = self.packed[np.cumsum([0, *range(n, 1, -1)])]
        mean = self.observations.targets - self.weights / diagonal
        variance = 1.0 / diagonal - self.observations.noise_variance
        return mean, np.clip(variance, 1e-9, self.hyperparameters.signal_std**2)


def train(
    observations: Observations, hyperparameters: Hyperparameters, gram: Gram = gram
) -> Expert:
    """Fit an expert to at least one observation.

    Args:
        gram: the kernel between all pairs of observations.

    Raises:
        TrainingError: the covariance is not positive definite, which finite evidence cannot cause.
    """
    refuse_empty(observations)
    observations = noisy(observations, hyperparameters)
    n = len(observations)
    k = gram(observations.kinds, observations.geometry, hyperparameters.length_scale_m)
    weights, packed = np.empty(n), np.empty(n * (n + 1) // 2)
    log_likelihood = condition(
        _room_for(k), observations.targets, observations.noise_variance,
        hyperparameters.signal_std**2, addresses_for(n), weights, packed,
    )  # fmt: skip
    refuse_indefinite(observations, log_likelihood)
    return Expert(observations, hyperparameters, weights, packed, log_likelihood)


def noisy(observations: Observations, hyperparameters: Hyperparameters) -> Observations:
    """The observations with the noise that the hyperparameters give them."""
    noise_variance = hyperparameters.noise_variance(observations)
    if noise_variance is observations.noise_variance:
        return observations
    return replace(observations, noise_variance=noise_variance)


def refuse_empty(observations: Observations) -> None:
    """Raise a TrainingError if there is nothing to train on."""
    if len(observations) == 0:
        raise TrainingError("an expert needs at least one observation, got none")


def refuse_indefinite(observations: Observations, log_likelihood: float) -> None:
    """Raise a TrainingError if the log likelihood tells that there was no inverse."""
    if not isfinite(log_likelihood):
        raise TrainingError(
            f"the covariance of {len(observations)} observations is not positive definite; "
            "check that their geometry and noise are finite"
        )


@compiled
def _room_for(k: NDArray[np.float64]) -> NDArray[np.float64]:
    edge = padded(len(k))
    a = np.empty((edge, edge))
    a[: len(k), : len(k)] = k
    return a


@compiled
def condition(
    a: NDArray[np.float64],
    targets: NDArray[np.float64],
    noise_variance: NDArray[np.float64],
    signal_variance: float,
    addresses: NDArray[np.int64],
    weights: NDArray[np.float64],
    packed: NDArray[np.float64],
) -> float:
    """From the kernel to an expert's weights (n,) and packed precision, which are written.

    Args:
        a: upper triangle of the kernel, as `inverse.sweep` takes it; destroyed.
        addresses: `inverse.addresses_for(n)`.

    Returns:
        The log marginal likelihood, which is not finite when the covariance is not positive
        definite.
    """
    n = len(targets)
    for i in range(n):
        if signal_variance != 1.0:
            for j in range(i, n):
                a[i, j] *= signal_variance
        a[i, i] += noise_variance[i]
    log_determinant = solve_and_pack(a, targets, addresses, weights, packed)
    fit = 0.0
    for i in range(n):
        fit += targets[i] * weights[i]
    return -0.5 * (fit + log_determinant + n * _LOG_TWO_PI)
