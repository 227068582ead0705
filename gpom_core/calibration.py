"""From the committee's mean and variance to a probability that means what it says.

Probabilistic least-squares classification (Rasmussen & Williams, section 6.5; Platt 1999):
p = Phi((a m + b) / sqrt(1 + a^2 v)), with a and b fitted by leave-one-out likelihood on the
training data, never on held-out data.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.special import log_ndtr, ndtr

DEFAULT_SLOPE = 3.0  # before there is evidence to fit it: targets are +1 and -1, not infinite
_SLOPE_BOUNDS = (0.05, 50.0)
_OFFSET_BOUND = 10.0
_PULL = 0.03  # of log slope towards the default and of the offset towards 0, for thin evidence


@dataclass(frozen=True, slots=True)
class Calibration:
    """Slope a and offset b of the probit link; the default is the identity."""

    slope: float = 1.0
    offset: float = 0.0

    def probability(
        self, mean: NDArray[np.float64], variance: NDArray[np.float64]
    ) -> NDArray[np.float64]:
        """Probability of being occupied, shaped as the mean and variance of the latent function."""
        score = (self.slope * mean + self.offset) / np.sqrt(1.0 + self.slope**2 * variance)
        return np.asarray(ndtr(score))


def fit(
    mean: NDArray[np.float64],
    variance: NDArray[np.float64],
    occupied: NDArray[np.bool_],
    weight: NDArray[np.float64] | None = None,
    *,
    with_offset: bool = True,
    start: Calibration | None = None,
) -> Calibration:
    """Slope and offset of highest leave-one-out predictive likelihood.

    Args:
        mean, variance: (n,) of the latent function at each observation, itself left out.
        occupied: (n,) what was observed. weight: (n,) how often, 1 if not given.
        with_offset: without it unknown space is exactly 0.5.
        start: where to begin, the last calibration.
    """
    if len(mean) == 0:
        return Calibration()
    sign = np.where(occupied, 1.0, -1.0)
    share = np.ones(len(mean)) if weight is None else np.asarray(weight, np.float64)
    share = share / share.sum()

    def loss(theta: NDArray[np.float64]) -> tuple[float, NDArray[np.float64]]:
        pull = float(theta[0]) - np.log(DEFAULT_SLOPE)
        slope, offset = float(np.exp(theta[0])), float(theta[1]) if with_offset else 0.0
        root = 1.0 / np.sqrt(1.0 + slope**2 * variance)
        score = (slope * mean + offset) * root
        log_p = np.asarray(log_ndtr(sign * score))
        # d log Phi(z) / dz = phi(z) / Phi(z), taken in logarithms where Phi underflows.
        ratio = sign * np.exp(-0.5 * score**2 - 0.5 * np.log(2.0 * np.pi) - log_p)
        by_slope = (mean - offset * slope * variance) * root**3 * slope
        value = -float(share @ log_p) + _PULL * (pull**2 + offset**2)
        gradient = np.array(
            [
                -float(share @ (ratio * by_slope)) + 2.0 * _PULL * pull,
                (-float(share @ (ratio * root)) + 2.0 * _PULL * offset) if with_offset else 0.0,
            ]
        )
        return value, gradient

    # Not at the top: it takes a fifth of a second, which a service that restarts need not wait for.
    from scipy.optimize import minimize  # noqa: PLC0415

    first = start or Calibration()
    found = minimize(
        loss,
        np.array([np.log(first.slope), first.offset if with_offset else 0.0]),
        jac=True,
        method="L-BFGS-B",
        bounds=[tuple(np.log(_SLOPE_BOUNDS)), (-_OFFSET_BOUND, _OFFSET_BOUND)],
    )
    return Calibration(float(np.exp(found.x[0])), float(found.x[1]) if with_offset else 0.0)
