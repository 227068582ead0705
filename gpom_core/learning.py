"""Learning an expert's hyperparameters by maximum marginal likelihood (the paper's section 3).

Four numbers are learned: length scale, standard deviation of the signal, and the factors on the
noise of hits and of free evidence. They are sought in logarithms, within bounds, pulled towards
values shared by all experts (a log-normal prior), so that an expert of ten observations cannot run
away. Gradients are analytic, through the integral kernels.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from math import exp, inf, log, pi

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize

from gpom_core import lapack
from gpom_core.errors import ConfigurationError
from gpom_core.expert import Hyperparameters, TrainingError
from gpom_core.kernel_gradients import gram_with_slope
from gpom_core.observations import Observations

Clock = Callable[[], float]
"""Seconds that only ever grow, such as `time.monotonic`; this package reads none itself."""

_Floats = NDArray[np.float64]
_NAMES = ("length_scale_m", "signal_std", "hit_noise_scale", "free_noise_scale")
_ENOUGH = 1e-3  # nats; a smaller gain ends the search


@dataclass(frozen=True, slots=True)
class LearningRule:
    """How to learn.

    Attributes:
        spread: standard deviation of the logarithms of hyperparameters around the shared values;
            the smaller, the stronger the pull. inf for none.
        reach: farthest factor from the shared values, either way.
        evaluations: of likelihood and gradient, at most.
        budget_s: no new evaluation begins after this; needs a clock. What is learned then depends
            on the machine, so limit `evaluations` where answers must repeat.
        learned: names of the hyperparameters to learn; the others keep their shared value.

    Raises:
        ConfigurationError: a value is out of range or a name is unknown.
    """

    spread: float = 0.5
    reach: float = 10.0
    evaluations: int = 50
    budget_s: float = inf
    learned: tuple[str, ...] = _NAMES

    def __post_init__(self) -> None:
        checks = {
            "spread must be positive": self.spread > 0.0,
            "reach must be more than 1": self.reach > 1.0,
            "evaluations must be at least 1": self.evaluations >= 1,
            "budget_s must be positive": self.budget_s > 0.0,
            f"learned must name some of {_NAMES}": set(self.learned) <= set(_NAMES),
        }
        for rule, holds in checks.items():
            if not holds:
                raise ConfigurationError(f"{rule}, got {self}")


@dataclass(frozen=True, slots=True)
class Learned:
    """What came out.

    Attributes:
        log_likelihood: log marginal likelihood of the targets.
        evaluations: of likelihood and gradient.
        converged: False when a limit ended the search; the values are the best seen.
    """

    hyperparameters: Hyperparameters
    log_likelihood: float
    evaluations: int
    converged: bool


class _OutOfBudgetError(Exception):
    """Ends the search from inside the objective."""


def log_likelihood_with_gradient(
    observations: Observations, hyperparameters: Hyperparameters
) -> tuple[float, _Floats]:
    """Log marginal likelihood of the targets, and its gradient.

    Returns:
        The value, and (4,) derivatives by the logarithms of length scale, signal standard
        deviation, hit noise scale and free noise scale (Rasmussen & Williams, eq. 5.9).

    Raises:
        TrainingError: the covariance is not positive definite.
    """
    value, slope = gram_with_slope(
        observations.kinds, observations.geometry, hyperparameters.length_scale_m
    )
    signal = hyperparameters.signal_std**2
    noise = hyperparameters.noise_variance(observations)
    precision = signal * value
    precision[np.diag_indices_from(precision)] += noise
    log_determinant = lapack.inverse_spd(precision, lapack.ADDRESSES)
    if not np.isfinite(log_determinant):
        raise TrainingError(
            f"the covariance of {len(observations)} observations is not positive definite at "
            f"{hyperparameters}; learn within narrower bounds"
        )
    targets = observations.targets
    weights = precision @ targets
    fit = float(targets @ weights)
    n = len(targets)
    # 1/2 tr((a a' - K^-1) dK), with dK the slope, the kernel (K less its noise) and the noise
    diagonal = noise * (weights**2 - np.diagonal(precision))
    hit = targets > 0.0
    gradient = np.array(
        [
            0.5 * signal * (float(weights @ (slope @ weights)) - _dot(precision, slope)),
            (fit - n) - float(diagonal.sum()),
            float(diagonal[hit].sum()),
            float(diagonal[~hit].sum()),
        ]
    )
    return -0.5 * (fit + log_determinant + n * log(2.0 * pi)), gradient


def learn(
    observations: Observations,
    shared: Hyperparameters,
    *,
    rule: LearningRule | None = None,
    start: Hyperparameters | None = None,
    clock: Clock | None = None,
) -> Learned:
    """Find an expert's hyperparameters.

    Args:
        observations: at least one.
        shared: values that all experts are pulled to.
        rule: how to learn.
        start: where to begin, such as what was learned from less evidence; else `shared`.
        clock: for `LearningRule.budget_s`.

    Raises:
        ConfigurationError: the rule has a time budget, but there is no clock.
        TrainingError: there are no observations.
    """
    rule = rule or LearningRule()
    if clock is None and rule.budget_s < inf:
        raise ConfigurationError("a time budget needs a clock, such as time.monotonic")
    if len(observations) == 0:
        raise TrainingError("learning needs at least one observation, got none")
    search = _Search(observations, shared, rule, clock)
    width = np.array([log(rule.reach) if name in rule.learned else 0.0 for name in _NAMES])
    first = np.zeros(4) if start is None else search.offset_of(start)
    try:
        found = minimize(
            search.loss,
            np.clip(first, -width, width),
            jac=True,
            method="L-BFGS-B",
            bounds=list(zip(-width, width, strict=True)),
            options={"ftol": _ENOUGH / max(1.0, len(observations)), "gtol": _ENOUGH},
        )
        converged = bool(found.success)
    except _OutOfBudgetError:
        converged = False
    return Learned(search.at(search.best), search.best_likelihood, search.evaluations, converged)


class _Search:
    """The objective in offsets of the logarithms from the shared values, and the best so far."""

    def __init__(
        self,
        observations: Observations,
        shared: Hyperparameters,
        rule: LearningRule,
        clock: Clock | None,
    ) -> None:
        self._observations, self._shared, self._rule = observations, shared, rule
        self._clock = clock
        self._end_s = inf if clock is None else clock() + rule.budget_s
        self.evaluations = 0
        self.best, self.best_likelihood, self._least = np.zeros(4), -inf, inf

    def at(self, offset: _Floats) -> Hyperparameters:
        """Hyperparameters at an offset (4,)."""
        values = {
            name: getattr(self._shared, name) * exp(float(o))
            for name, o in zip(_NAMES, offset, strict=True)
        }
        return Hyperparameters(**values)

    def offset_of(self, hyperparameters: Hyperparameters) -> _Floats:
        """Where hyperparameters are."""
        return np.array(
            [log(getattr(hyperparameters, n) / getattr(self._shared, n)) for n in _NAMES]
        )

    def loss(self, offset: _Floats) -> tuple[float, _Floats]:
        """Negative log posterior and its gradient (4,)."""
        spent = self.evaluations >= self._rule.evaluations
        late = self._clock is not None and self.evaluations > 0 and self._clock() > self._end_s
        if spent or late:
            raise _OutOfBudgetError
        self.evaluations += 1
        likelihood, gradient = log_likelihood_with_gradient(self._observations, self.at(offset))
        pulled = offset / self._rule.spread**2
        value = 0.5 * float(offset @ pulled) - likelihood
        if value < self._least:
            self._least, self.best, self.best_likelihood = value, offset.copy(), likelihood
        return value, pulled - gradient


def _dot(a: _Floats, b: _Floats) -> float:
    """Sum of the products of two matrices' elements."""
    return float(np.dot(a.ravel(), b.ravel()))
