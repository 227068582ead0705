"""From what the committee says at a place to a probability that means what it says.

With the latent mean m, the share u of the prior variance that is left, w = 1 - u, and what the hits
and the passes at the very place weigh, H and F:

    log(p / (1 - p)) = a m + b ((m + k w)^3 - (k w)^3) + c log(1 + H) - d log(1 + F) + w (e + f u)

Every term vanishes where nothing is known, so unknown space stays at one half. For one link and one
u, more mean or more hits are never less probability, more passes never more; what is seen again
may still move m and u, by another length scale, and the weights, by another calibration.

The cubic is what evidence that contradicts itself needs (an expert's mean is then near the share of
hits, and so is the probability). The two logarithms are what a grid knows and a process smooths
over: how often this very place was hit and passed, however sure it is of both. The last term is for
the edges of known space: half-known places are where beams end. The probit link of the paper,
Phi(a m / sqrt(1 + a^2 v)), has none of them (measured in docs/accuracy.md);
`gpom_core.calibration` has it for the batch maps of the paper.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import product

import numpy as np
from numpy.typing import NDArray

from gpom_core.committee import OF_HITS, OF_INFORMATION, OF_PASSES, OF_PRECISION, SUMS
from gpom_core.jit import compiled, vectorised

_Floats = NDArray[np.float64]

DEFAULT_WEIGHTS = (2.94, 0.42, 0.8, 1.19, 0.83, 1.79)
"""a to f, fitted to left-out training scans of four buildings, whole and thinned."""

_SHIFT = 0.2  # k
_SPREAD = np.array([0.91, 1.04, 2.19, 1.66, 0.25, 0.07])  # of the terms on real maps
# Towards the default, of weights in units of `_SPREAD`; one observation weighs 1. How sure the mean
# is of itself, the first, is what differs most from site to site.
_PULL = np.array([1.0, 8.0, 8.0, 8.0, 8.0, 8.0])
_MEANS, _LEFT = np.linspace(-1.2, 1.2, 25), np.geomspace(1e-3, 1.0, 13)
_MUCH, _AT_ODDS = 5.0, 4.0  # log(1 + weight), of places where all agrees and where nothing does
_ORDERED = 4  # first weights that must not be negative
_STEPS_MAX = 100  # about eight are enough
_STEP_LEAST, _SHARE_LEAST = 1e-10, 1e-6


@vectorised
def _log_odds(mean: float, left: float, hits: float, passes: float, weights: _Floats) -> float:
    known = 1.0 - left
    shift = _SHIFT * known
    cubed = (mean + shift) * (mean + shift) * (mean + shift) - shift * shift * shift
    smooth = weights[0] * mean + weights[1] * cubed + known * (weights[4] + weights[5] * left)
    return float(smooth + weights[2] * hits - weights[3] * passes)


@vectorised
def probability(mean: float, left: float, hits: float, passes: float, weights: _Floats) -> float:
    """Probability of being occupied, in compiled code.

    Args:
        mean: latent. left: share of the prior variance, in [0, 1].
        hits, passes: log(1 + weight) of those at the place. weights: (6,).
    """
    z = _log_odds(mean, left, hits, passes, weights)
    return float(1.0 / (1.0 + np.exp(-z)))


@compiled
def _probabilities(
    mean: _Floats, left: _Floats, hits: _Floats, passes: _Floats, weights: _Floats, out: _Floats
) -> None:
    for i in range(len(mean)):
        out[i] = probability(mean[i], min(left[i], 1.0), hits[i], passes[i], weights)


@compiled
def take_logarithms(sums: _Floats) -> None:
    """Of the committee's sums (n, 4), what hits and passes weigh becomes log(1 + weight)."""
    for i in range(len(sums)):
        for column in range(OF_HITS, SUMS):
            sums[i, column] = np.log1p(sums[i, column])


@compiled
def answers(
    sums: _Floats, prior: float, prior_variance: float, weights: _Floats
) -> tuple[_Floats, _Floats, _Floats]:
    """Mean, variance and probability, (n,) each, from what the committee says.

    Args:
        sums: (n, 4) as `take_logarithms` leaves them, without the prior.
        prior: its precision. prior_variance: of one expert. weights: (6,) of the link.
    """
    n = len(sums)
    mean, variance, occupancy = np.empty(n), np.empty(n), np.empty(n)
    for i in range(n):
        variance[i] = 1.0 / (sums[i, OF_PRECISION] + prior)
        mean[i] = sums[i, OF_INFORMATION] * variance[i]
        left = min(variance[i] / prior_variance, 1.0)
        hits, passes = sums[i, OF_HITS], sums[i, OF_PASSES]
        occupancy[i] = probability(mean[i], left, hits, passes, weights)
    return mean, variance, occupancy


@dataclass(frozen=True, slots=True)
class Link:
    """The weights a to f; the default is a good guess before there is evidence to fit.

    Raises:
        ValueError: not six finite numbers, or one of the first four is negative.
    """

    weights: tuple[float, ...] = DEFAULT_WEIGHTS

    def __post_init__(self) -> None:
        w = np.asarray(self.weights)
        if w.shape != (len(DEFAULT_WEIGHTS),) or not np.isfinite(w).all() or w[:_ORDERED].min() < 0:
            raise ValueError(
                f"weights are {self.weights}, expected six numbers, the first four not negative"
            )

    def probability(self, mean: _Floats, left: _Floats, hits: _Floats, passes: _Floats) -> _Floats:
        """Probability of being occupied, (n,).

        Args:
            mean: (n,) latent. left: (n,) share of the prior variance.
            hits, passes: (n,) log(1 + weight) of those at the place; the prior weighs 1.
        """
        out = np.empty(len(mean))
        _probabilities(mean, left, hits, passes, np.array(self.weights), out)
        return out

    def differs(self, other: Link, tolerance: float) -> bool:
        """Whether any probability of what maps are likely to say differs by more than this."""
        mean, left = (axis.ravel() for axis in np.meshgrid(_MEANS, _LEFT))
        none, both = np.zeros(len(mean)), np.full(len(mean), _AT_ODDS)
        agreeing = _MUCH * np.maximum(mean, 0.0), _MUCH * np.maximum(-mean, 0.0)
        for hits, passes in ((none, none), (both, both), agreeing):
            ours, theirs = (one.probability(mean, left, hits, passes) for one in (self, other))
            if np.abs(ours - theirs).max() > tolerance:
                return True
        return False


def fit(
    mean: _Floats, left: _Floats, hits: _Floats, passes: _Floats, occupied: NDArray[np.bool_]
) -> Link:
    """The link of highest likelihood, held near the default where there is little to tell.

    Args:
        mean: (n,) latent, at observations that are left out. left: (n,) share of the prior
            variance. hits, passes: (n,) as in `Link.probability`. occupied: (n,) what was observed.
    """
    if len(mean) == 0:
        return Link()
    terms = _terms(mean, np.minimum(left, 1.0), hits, passes) / _SPREAD
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
        step = _lowest(curvature + 2.0 * np.diag(_PULL), slope, at) - at
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
    return float(np.logaddexp(0.0, -(signed @ weights)).sum() + _PULL @ pull**2)


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


def _terms(mean: _Floats, left: _Floats, hits: _Floats, passes: _Floats) -> _Floats:
    known = 1.0 - left
    shift = _SHIFT * known
    cubed = (mean + shift) ** 3 - shift**3
    return np.column_stack([mean, cubed, hits, -passes, known, known * left])
