"""The log marginal likelihood of an expert, its gradient, and where to step; all compiled.

Hyperparameters are vectors of four: length scale, signal standard deviation, hit noise scale and
free noise scale. The search is in offsets of their logarithms from the shared values. Four numbers
and evaluations of microseconds: a general optimiser would cost more than what it optimises, and
hold the interpreter lock meanwhile.
"""

from __future__ import annotations

from typing import Final

import numpy as np
from numpy.typing import NDArray

from gpom_core.inverse import inverse_spd
from gpom_core.jit import compiled
from gpom_core.kernel_gradients import gram_with_slope_into

_Floats = NDArray[np.float64]

LONGEST_STEP: Final = 0.7  # in logarithms: a factor of two
_FLAT: Final = 1e-3  # nats; gradients below it end the search


@compiled
def log_likelihood(
    values: _Floats,
    kinds: NDArray[np.uint8],
    geometry: _Floats,
    targets: _Floats,
    noise_variance: _Floats,
    addresses: NDArray[np.int64],
    gradient: _Floats,
) -> float:
    """Log marginal likelihood of the targets; NaN if the covariance is not positive definite.

    Args:
        values: (4,) hyperparameters. addresses: `inverse.addresses_for(n)`.
        gradient: (4,) out, derivatives by the logarithms of the hyperparameters: with dK the slope
            of the kernel, the kernel, and the noise, 1/2 tr((alpha alpha' - K^-1) dK)
            (Rasmussen & Williams, eq. 5.9).
    """
    n, _, d = geometry.shape
    precision, slope = np.empty((n, n)), np.empty((n, n))
    inverse = np.full(d, 1.0 / values[0])
    gram_with_slope_into(kinds, geometry, inverse, precision, slope)
    signal = values[1] * values[1]
    noise = np.empty(n)
    for i in range(n):
        scale = values[2] if targets[i] > 0.0 else values[3]
        noise[i] = noise_variance[i] * scale * scale
        for j in range(n):
            precision[i, j] *= signal
        precision[i, i] += noise[i]
    log_determinant = inverse_spd(precision, addresses)
    weights = np.zeros(n)
    fit = 0.0
    for i in range(n):
        for j in range(n):
            weights[i] += precision[i, j] * targets[j]
        fit += weights[i] * targets[i]
    gradient[:] = 0.0
    gradient[1] = fit - n
    for i in range(n):
        by_slope = 0.0
        for j in range(n):
            by_slope += (weights[i] * weights[j] - precision[i, j]) * slope[i, j]
        gradient[0] += 0.5 * signal * by_slope
        by_noise = noise[i] * (weights[i] * weights[i] - precision[i, i])
        gradient[1] -= by_noise
        gradient[2 if targets[i] > 0.0 else 3] += by_noise
    value: float = -0.5 * (fit + log_determinant + n * np.log(2.0 * np.pi))
    return value


@compiled
def negative_log_posterior(
    offset: _Floats,
    shared: _Floats,
    spread: float,
    kinds: NDArray[np.uint8],
    geometry: _Floats,
    targets: _Floats,
    noise_variance: _Floats,
    addresses: NDArray[np.int64],
    gradient: _Floats,
) -> tuple[float, float]:
    """What learning minimises at an offset (4,), and the log likelihood; gradient (4,) is out."""
    values = shared * np.exp(offset)
    likelihood = log_likelihood(
        values, kinds, geometry, targets, noise_variance, addresses, gradient
    )
    loss = -likelihood
    for a in range(len(offset)):
        pulled = offset[a] / (spread * spread)
        loss += 0.5 * offset[a] * pulled
        gradient[a] = pulled - gradient[a]
    return loss, likelihood


@compiled
def direction_of(offset: _Floats, gradient: _Floats, curvature: _Floats, width: _Floats) -> _Floats:
    """Quasi-Newton direction (4,) of a projected BFGS search (Nocedal & Wright, chapter 6).

    Numbers at a bound that the gradient pushes outward stay; zero where the search is flat.

    Args:
        curvature: (4, 4) estimate of the inverse Hessian; forgotten if it does not descend.
        width: (4,) bounds of |offset|.
    """
    n = len(offset)
    free = np.zeros(n, np.bool_)
    steepest = 0.0
    for a in range(n):
        outward = (offset[a] >= width[a] and gradient[a] < 0.0) or (
            offset[a] <= -width[a] and gradient[a] > 0.0
        )
        free[a] = width[a] > 0.0 and not outward
        if free[a]:
            steepest = max(steepest, abs(gradient[a]))
    out = np.zeros(n)
    if steepest < _FLAT:
        return out
    descent, longest = 0.0, 0.0
    for a in range(n):
        if free[a]:
            for b in range(n):
                if free[b]:
                    out[a] -= curvature[a, b] * gradient[b]
            descent += out[a] * gradient[a]
    if not descent < 0.0:
        curvature[:] = np.eye(n)
        for a in range(n):
            out[a] = -gradient[a] if free[a] else 0.0
    for a in range(n):
        longest = max(longest, abs(out[a]))
    return out * min(1.0, LONGEST_STEP / longest)


@compiled
def learn_curvature(curvature: _Floats, moved: _Floats, change: _Floats) -> None:
    """BFGS update of the inverse Hessian."""
    n = len(moved)
    product = 0.0
    for a in range(n):
        product += moved[a] * change[a]
    if product <= 1e-12:
        return
    turned = np.zeros(n)
    bend = 0.0
    for a in range(n):
        for b in range(n):
            turned[a] += curvature[a, b] * change[b]
        bend += turned[a] * change[a]
    for a in range(n):
        for b in range(n):
            curvature[a, b] += (1.0 + bend / product) * moved[a] * moved[b] / product
            curvature[a, b] -= (turned[a] * moved[b] + moved[a] * turned[b]) / product
