"""Learning an expert's hyperparameters by maximum marginal likelihood (the paper's section 3).

Four numbers are learned: length scale, standard deviation of the signal, and the factors on the
noise of hits and of free evidence. They are sought in logarithms, within bounds, pulled towards
values shared by all experts (a log-normal prior), so that an expert of ten observations cannot run
away. Gradients are analytic, through the integral kernels.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from math import inf, log

import numpy as np
from numpy.typing import NDArray

from gpom_core.errors import ConfigurationError
from gpom_core.expert import Hyperparameters, TrainingError
from gpom_core.inverse import addresses_for
from gpom_core.likelihood import direction_of, learn_curvature, negative_log_posterior
from gpom_core.observations import Observations

Clock = Callable[[], float]
"""Seconds that only ever grow, such as `time.monotonic`; this package reads none itself."""

_Floats = NDArray[np.float64]
_NAMES = ("length_scale_m", "signal_std", "hit_noise_scale", "free_noise_scale")
_SHORTEST_STEP = 1e-4  # in logarithms
_SHARE_OF_GAIN = 1e-4  # of what the gradient promised, that a step must bring (Armijo)
_ENOUGH = 1e-2  # nats; a step of less gain ends the search: no likelihood is known that well


@dataclass(frozen=True, slots=True)
class LearningRule:
    """How to learn.

    Attributes:
        spread: standard deviation of the logarithms of hyperparameters around the shared values;
            the smaller, the stronger the pull. inf for none.
        reach: farthest factor from the shared values, either way.
        evaluations: of likelihood and gradient, at most.
        budget_s: no new step begins after this; needs a clock. What is learned then depends
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
    gradient = np.empty(4)
    loss, _ = negative_log_posterior(
        np.zeros(4), _vector(hyperparameters), inf, *_arrays(observations), gradient
    )
    if not np.isfinite(loss):
        raise TrainingError(
            f"the covariance of {len(observations)} observations is not positive definite at "
            f"{hyperparameters}; learn within narrower bounds"
        )
    return -loss, -gradient


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
        TrainingError: there are no observations, or they are not finite.
    """
    rule = rule or LearningRule()
    if clock is None and rule.budget_s < inf:
        raise ConfigurationError("a time budget needs a clock, such as time.monotonic")
    if len(observations) == 0:
        raise TrainingError("learning needs at least one observation, got none")
    search = _Search(observations, shared, rule, start or shared)
    end_s = inf if clock is None else clock() + rule.budget_s
    converged = False
    while not converged and search.left > 0 and (clock is None or clock() <= end_s):
        converged = search.step() < _ENOUGH and search.left > 0
    return search.learned(converged)


class _Search:
    """Where the search is, in offsets of the logarithms from the shared values."""

    def __init__(
        self,
        observations: Observations,
        shared: Hyperparameters,
        rule: LearningRule,
        start: Hyperparameters,
    ) -> None:
        self._shared, self._spread = _vector(shared), rule.spread
        self._arrays = _arrays(observations)
        self._width = np.array([log(rule.reach) * (name in rule.learned) for name in _NAMES])
        self._evaluations = self.left = rule.evaluations
        self._curvature = np.eye(4)
        offset = np.log(_vector(start) / self._shared)
        self._offset = np.clip(offset, -self._width, self._width)
        self._loss, self._likelihood, self._gradient = self._evaluate(self._offset)
        if not np.isfinite(self._loss):
            raise TrainingError(
                f"the covariance of {len(observations)} observations is not positive definite "
                "where learning starts; check that their geometry and noise are finite"
            )

    def step(self) -> float:
        """Take a step that gains, halving it until it does; how much the posterior gained."""
        direction = direction_of(self._offset, self._gradient, self._curvature, self._width)
        longest, share = float(np.abs(direction).max()), 1.0
        while self.left > 0 and share * longest > _SHORTEST_STEP:
            there = np.clip(self._offset + share * direction, -self._width, self._width)
            expected = float(self._gradient @ (there - self._offset))
            loss, likelihood, gradient = self._evaluate(there)
            gain = self._loss - loss
            if gain >= -_SHARE_OF_GAIN * expected:  # never true of NaN
                learn_curvature(self._curvature, there - self._offset, gradient - self._gradient)
                self._offset, self._gradient = there, gradient
                self._loss, self._likelihood = loss, likelihood
                return gain
            # the minimum of the parabola through what is known, within reason
            bend = -gain - expected
            share *= min(max(-0.5 * expected / bend, 0.1), 0.5) if bend > 0.0 else 0.25
        return 0.0

    def learned(self, converged: bool) -> Learned:
        """The result as it stands."""
        values = (self._shared * np.exp(self._offset)).tolist()
        return Learned(
            hyperparameters=Hyperparameters(**dict(zip(_NAMES, values, strict=True))),
            log_likelihood=self._likelihood,
            evaluations=self._evaluations - self.left,
            converged=converged,
        )

    def _evaluate(self, offset: _Floats) -> tuple[float, float, _Floats]:
        self.left -= 1
        gradient = np.empty(4)
        loss, likelihood = negative_log_posterior(
            offset, self._shared, self._spread, *self._arrays, gradient
        )
        return loss, likelihood, gradient


def _vector(hyperparameters: Hyperparameters) -> _Floats:
    return np.array([getattr(hyperparameters, name) for name in _NAMES], np.float64)


def _arrays(
    o: Observations,
) -> tuple[NDArray[np.uint8], _Floats, _Floats, _Floats, NDArray[np.int64]]:
    """What the compiled likelihood reads."""
    return o.kinds, o.geometry, o.targets, o.noise_variance, addresses_for(len(o))
