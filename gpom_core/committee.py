"""Fusion rules: the opinions of many experts into one (eq. 13 of Kim & Kim and its correction).

All rules are sums over experts of a precision and an information, so the order of the experts and
how they are divided among machines do not matter. An expert that knows nothing at a point
(variance = prior variance) contributes nothing there; what sets `poe` apart is its prior.
"""

from __future__ import annotations

from enum import IntEnum

import numpy as np
from numpy.typing import NDArray

from gpom_core.errors import InvalidQueryError
from gpom_core.jit import compiled

# Columns of the committee's sums at a point. All add up over experts, and over shards of them.
OF_PRECISION, OF_INFORMATION = 0, 1
OF_HITS, OF_PASSES = 2, 3  # what the evidence at the point itself weighs, priors weigh 1
SUMS = 4


class Fusion(IntEnum):
    """How the opinions of experts are merged."""

    BCM = 0  # Tresp, "A Bayesian committee machine" (2000)
    RBCM = 1  # Deisenroth & Ng, "Distributed Gaussian processes" (2015)
    POE = 2  # the paper's eq. 13 as printed: unexplored space looks certain

    @classmethod
    def named(cls, name: str) -> Fusion:
        """The rule called `name`, in lower case.

        Raises:
            InvalidQueryError: there is no such rule.
        """
        try:
            return cls[name.upper()]
        except (KeyError, AttributeError):
            known = ", ".join(rule.name.lower() for rule in cls)
            raise InvalidQueryError(
                f"fusion rule {name!r} is not known; use one of {known}"
            ) from None


@compiled
def contribution(
    fusion: int, mean: float, variance: float, prior_variance: float
) -> tuple[float, float]:
    """What one expert adds to the committee's precision and information at a point.

    Args:
        fusion: a `Fusion`. mean, variance: of the expert. prior_variance: of the expert there.
    """
    if fusion == 1:
        weight = 0.5 * (np.log(prior_variance) - np.log(variance))
        return weight * (1.0 / variance - 1.0 / prior_variance), weight * mean / variance
    return 1.0 / variance - 1.0 / prior_variance, mean / variance


@compiled
def prior_precision(fusion: int, prior_variance: float, experts: int) -> float:
    """The committee's precision where no expert knows anything.

    With `poe` each of the experts, however far, adds the precision of its prior.
    """
    if fusion == 2 and experts > 0:
        return experts / prior_variance
    return 1.0 / prior_variance


def fuse(
    means: NDArray[np.float64],
    variances: NDArray[np.float64],
    prior_variance: float,
    fusion: Fusion = Fusion.BCM,
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Merge the opinions of k experts at m points.

    Args:
        means, variances: (k, m). prior_variance: shared by the experts.

    Returns:
        mean and variance, (m,) each.
    """
    if means.shape != variances.shape or means.ndim != 2:
        raise ValueError(f"means {means.shape} and variances {variances.shape} must both be (k, m)")
    precision = np.full(means.shape[1], prior_precision(fusion, prior_variance, len(means)))
    information = np.zeros(means.shape[1])
    for mean, variance in zip(means, variances, strict=True):
        for j in range(means.shape[1]):
            p, i = contribution(fusion, mean[j], variance[j], prior_variance)
            precision[j] += p
            information[j] += i
    return information / precision, 1.0 / precision
