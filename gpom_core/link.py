"""From the committee's mean and variance to a probability that means what it says.

With the latent mean m, the share u of the prior variance that is left, and w = 1 - u:

    log(p / (1 - p)) = m (a + b log(1/u)) + c ((m + k w)^3 - (k w)^3) + w (d + e u)

Every term vanishes where nothing is known, so unknown space stays at one half, and none but the
last depends on anything but m in an order-keeping way: more mean is never less probability. The
cubic is what evidence that contradicts itself needs (an expert's mean is then near the share of
hits, and so is the probability), and the last term what the edges of known space need: half-known
places are where beams end. The probit link of the paper, Phi(a m / sqrt(1 + a^2 v)), has neither
(measured in docs/accuracy.md); `gpom_core.calibration` has it for the batch maps of the paper.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import product

import numpy as np
from numpy.typing import NDArray

from gpom_core.jit import compiled, vectorised

_Floats = NDArray[np.float64]

DEFAULT_WEIGHTS = (3.86, 0.21, 0.75, -0.52, 5.97)
"""a, b, c, d, e fitted to left-out training scans of four buildings, whole and thinned."""

_SHIFT = 0.2  # k
_SPREAD = np.array([0.87, 2.84, 1.01, 0.31, 0.08])  # of the terms on real maps
_PULL = 10.0  # towards the default, of weights in units of `_SPREAD`; one observation weighs 1
_LEAST_VARIANCE = 1e-9  # share of the prior
_MEANS, _LEFT = np.linspace(-1.2, 1.2, 25), np.geomspace(1e-3, 1.0, 13)
_ORDERED = 3  # weights that must not be negative
_STEPS_MAX = 100  # about eight are enough
_STEP_LEAST, _SHARE_LEAST = 1e-10, 1e-6


@vectorised
def _log_odds(mean: float, left: float, a: float, b: float, c: float, d: float, e: float) -> float:
    known = 1.0 - left
    shift = _SHIFT * known
    cubed = (mean + shift) * (mean + shift) * (mean + shift) - shift * shift * shift
    return float(mean * (a - b * np.log(left)) + c * cubed + known * (d + e * left))


@vectorised
def probability(mean: float, left: float, weights: _Floats) -> float:
    """Probability of being occupied, in compiled code.

    Args:
        mean: latent. left: share of the prior variance, in [1e-9, 1]. weights: (5,).
    """
    z = _log_odds(mean, left, weights[0], weights[1], weights[2], weights[3], weights[4])
    return float(1.0 / (1.0 + np.exp(-z)))


@compiled
def _probabilities(mean: _Floats, left: _Floats, weights: _Floats, out: _Floats) -> None:
    for i in range(len(mean)):
        out[i] = probability(mean[i], min(max(left[i], _LEAST_VARIANCE), 1.0), weights)


@dataclass(frozen=True, slots=True)
class Link:
    """The weights a, b, c, d, e; the default is a good guess before there is evidence to fit.

    Raises:
        ValueError: not five finite numbers, or a negative a, b or c.
    """

    weights: tuple[float, ...] = DEFAULT_WEIGHTS

    def __post_init__(self) -> None:
        w = np.asarray(self.weights)
        if w.shape != (len(DEFAULT_WEIGHTS),) or not np.isfinite(w).all() or w[:_ORDERED].min() < 0:
            raise ValueError(
                f"weights are {self.weights}, expected five numbers, the first three not negative"
            )

    def probability(self, mean: _Floats, variance: _Floats, prior_variance: float) -> _Floats:
        """Probability of being occupied, shaped as the latent mean and variance."""
        flat = np.ascontiguousarray(mean, np.float64).reshape(-1)
        left = np.ascontiguousarray(variance, np.float64).reshape(-1) / prior_variance
        out = np.empty(len(flat))
        _probabilities(flat, left, np.array(self.weights), out)
        return out.reshape(np.shape(mean))

    def differs(self, other: Link, tolerance: float) -> bool:
        """Whether any probability differs by more than a tolerance."""
        mean, left = np.meshgrid(_MEANS, _LEFT)
        ours, theirs = (one.probability(mean, left, 1.0) for one in (self, other))
        return bool(np.abs(ours - theirs).max() > tolerance)


def fit(mean: _Floats, left: _Floats, occupied: NDArray[np.bool_]) -> Link:
    """The link of highest likelihood, held near the default where there is little to tell.

    Args:
        mean: (n,) latent, at observations that are left out. left: (n,) share of the prior
            variance. occupied: (n,) what was observed.
    """
    if len(mean) == 0:
        return Link()
    terms = _terms(mean, np.clip(left, _LEAST_VARIANCE, 1.0)) / _SPREAD
    signed = terms * np.where(occupied, 1.0, -1.0)[:, None]
    # Exactly the best: a restarted service calibrates as one that went on.
    best = _likeliest(signed, np.array(DEFAULT_WEIGHTS) * _SPREAD)
    return Link(tuple((best / _SPREAD).tolist()))


def _likeliest(signed: _Floats, default: _Floats) -> _Floats:
    """The weights of least loss, the first of them not negative, by Newton's method.

    The loss is strictly convex. Each step goes to the lowest place of its quadratic model within
    the bounds, or less far where the loss does not fall enough on the way (Armijo's rule).
    """
    at, loss = default, _loss(signed, default, default)
    for _ in range(_STEPS_MAX):
        miss = 0.5 - 0.5 * np.tanh(0.5 * (signed @ at))  # how unlikely it held what happened
        slope = 2.0 * _PULL * (at - default) - miss @ signed
        curvature = (signed * (miss * (1.0 - miss))[:, None]).T @ signed
        step = _lowest(curvature + 2.0 * _PULL * np.eye(len(at)), slope, at) - at
        promised, share = float(slope @ step), 1.0
        while (there := _loss(signed, at + share * step, default)) > loss + 0.25 * share * promised:
            share *= 0.5
            if share < _SHARE_LEAST:  # rounding hides what is left to gain
                return at
        at, loss = at + share * step, there
        if np.abs(share * step).max() < _STEP_LEAST:
            break
    return at


def _loss(signed: _Floats, weights: _Floats, default: _Floats) -> float:
    pull = weights - default
    return float(np.logaddexp(0.0, -(signed @ weights)).sum()) + _PULL * float(pull @ pull)


def _lowest(curvature: _Floats, slope: _Floats, at: _Floats) -> _Floats:
    """Where a quadratic is lowest within the bounds: the best of what is lowest on each face."""
    found, least = at, 0.0
    for held in product((False, True), repeat=_ORDERED):
        free = ~np.array([*held, *[False] * (len(at) - _ORDERED)])
        place = np.where(free, at, 0.0)
        pull = slope + curvature @ (place - at)
        place[free] -= np.linalg.solve(curvature[np.ix_(free, free)], pull[free])
        move = place - at
        value = float(slope @ move + 0.5 * move @ curvature @ move)
        if place[:_ORDERED].min() >= 0.0 and value < least:
            found, least = place, value
    return found


def _terms(mean: _Floats, left: _Floats) -> _Floats:
    known = 1.0 - left
    shift = _SHIFT * known
    columns = [mean, -mean * np.log(left), (mean + shift) ** 3 - shift**3, known, known * left]
    return np.column_stack(columns)
